#!/bin/sh
# Create the folder data/ from a checkout: sh tests/golden/make_data.sh CHECKOUT PYTHON
# Done once, at edbb4ea; a new run differs (times, addresses), and so would every record.
set -eu
root=$(cd "$1" && pwd); python=$2; data=$(cd "$(dirname "$0")" && pwd)/data
part=$(mktemp -d); mkdir -p "$data/models"
export PYTHONPATH="$root" OMP_NUM_THREADS=1
cd "$root"

# Sessions: one target each on the mock bench, with few, noise-free pictures to limit the size.
cat > "$part/small.yaml" <<END
extends: $root/rig/bench/benches/gelsight.yaml
camera: {rate_hz: 5.0}
world: {noise: {grey: 0.0}}
END
rig() {
    "$python" -m tactile collect "$@" --targets 1 --indenter cylinder --operator golden \
        --calibrations "$part/none"
}
[ -e "$data/gelsight.zarr" ] || rig --bench "$part/small.yaml" --out "$part/gelsight.zarr"
[ -e "$data/uskin.zarr" ] || rig --sensor uskin --out "$part/uskin.zarr"
for name in gelsight uskin; do
    [ -e "$data/$name.zarr" ] && continue
    mv "$part/$name.zarr" "$data/$name.zarr"
    sed -i 's/"system": "[^"]*"/"system": "Linux"/' "$data/$name.zarr/zarr.json"
done

# An archive of three simulated sensors: two skins that differ in modulus, and taxels.
archive=$data/skins.markers.zarr split=$data/split.json
rm -rf "$archive"
"$python" -m tactile sim archive r6,r18,uskin --tier layer --scale 0.03 --steps 2 \
    --indenters sphere,prism,cone --processes 1 --no-check --out "$archive"
"$python" -c "import sys
from pathlib import Path
from learning.data.splits import make_split
from recorder.archive import MarkerArchive
make_split(MarkerArchive(Path(sys.argv[1])), validation=0.2, new_press=0.2).write(Path(sys.argv[2]))" \
    "$archive" "$split"

# Models of each kind, trained for a few steps.
learning() { kind=$2; shift 2; "$python" -m tactile train "$kind" "$archive" --split "$split" "$@"; }
learning train force --sensor r6 --out "$part/force" --preset tiny --set input.side_px=32 \
    --set 'stages=[{epochs: 2, learning_rate: 0.002}]' --set 'network.encoder=[4, 4, 8]' \
    --set network.memory=8 --set 'network.tail=[8, 8]'
learning train field --out "$part/field" --preset cpu_smoke --sensors r6,r18 \
    --set field_stage.steps=2 --set field_stage.warm_up_steps=1 --set field_stage.batch=2 \
    --set map_stage.steps=2 --set map_stage.warm_up_steps=1 --set map_stage.batch=2 \
    --set validate_every_steps=2 --set validated=2 --set 'net.widths=[8, 8, 16, 16, 16]' \
    --set 'map.widths=[8, 8, 8, 8]' --set map.numbers=4 --set examples.patterns=4
# Networks like SD-Turbo with a few thousand random weights, from a test helper.
rm -rf "$data/base"
PYTHONPATH="$root:$root/tests" "$python" -c "import sys
from pathlib import Path
from tiny_diffusion import DEEP_VAE, write_base
write_base(Path(sys.argv[1]), DEEP_VAE)" "$data/base"
few="--set steps=2 --set batch=2 --set launch.device=cpu --set launch.mixed_precision=no"
learning train diffusion --out "$part/diffusion" --sensors r6,r18 --base "$data/base" $few \
    --set marker_vae.steps=2 --set marker_vae.batch=2 --set unet_rank=2 --set vae_rank=2 \
    --set losses.adversarial=0 --set losses.perceptual=0
mv "$part/diffusion/marker-vae" "$part/marker-vae"
for kind in force field marker-vae diffusion; do
    mkdir -p "$data/models/$kind"
    cp "$part/$kind/config.yaml" "$part/$kind/model.safetensors" "$data/models/$kind"
    sed -i "s#$data/base#\"{data}/base\"#" "$data/models/$kind/config.yaml"
done
rm -rf "$part"
