from typing import Any

import pytest
import torch
from support.force_models import toy
from torch.utils.flop_counter import FlopCounterMode

from learning.config import preset_names, read_settings
from learning.force.model import ForceModel, ForceNetworkSettings, InputSettings, prepare
from learning.force.train import PRESETS, ForceModelSettings, error


def _preset(name: str) -> ForceModel:
    settings = read_settings(ForceModelSettings, PRESETS, name)
    with torch.device("meta"):
        return ForceModel(settings.network, settings.input)


def _count(module: torch.nn.Module) -> int:
    return sum(weight.numel() for weight in module.parameters())


def _model(**changes: Any) -> ForceModel:
    torch.manual_seed(0)
    return ForceModel(toy(**changes).network, toy(**changes).input)


def test_the_papers_network_has_as_many_weights_as_its_description_gives() -> None:
    # RAFT's encoder, three 3 x 3 gates from 256 to 128, ResNet-18's blocks up to 256 and 512.
    model = _preset("paper")
    assert _count(model.encoder) == 1_050_336
    assert _count(model.memory) == 3 * (256 * 128 * 9 + 128)
    assert _count(model.tail) == 4_592_128
    assert _count(model.head) == 512 * 3 + 3
    assert round(_count(model) / 1e6, 2) == 6.53


def test_a_frame_costs_the_papers_network_as_many_operations_as_were_measured() -> None:
    model = _preset("paper")
    with FlopCounterMode(display=False) as counted, torch.device("meta"):
        model.step(torch.empty(1, 3, 256, 256))
    assert counted.get_total_flops() / 1e9 == pytest.approx(11.62, abs=0.01)


@pytest.mark.parametrize("name", preset_names(PRESETS))
def test_presets_make_models_that_take_what_they_say(name: str) -> None:
    model = _preset(name)
    frame = torch.empty(2, model.inputs.planes, model.inputs.side, model.inputs.side, device="meta")
    force, state = model.step(frame)
    assert force.shape == (2, 3)
    assert state.shape == (2, *model.state_shape) == model.initial_state(2).shape


@pytest.mark.parametrize("name", ["displacement", "shading"])
def test_presets_whose_input_is_0_without_contact_keep_the_size_of_a_change(name: str) -> None:
    settings = read_settings(ForceModelSettings, PRESETS, name)
    torch.manual_seed(0)
    encoder = ForceModel(settings.network, settings.input).encoder
    frames = torch.randn(2, settings.input.planes, 64, 64)
    with torch.no_grad():
        features, of_half = encoder(frames), encoder(frames / 2)
    assert float((features - of_half).norm() / features.norm()) > 0.3


def _gradients(model: ForceModel, frames: torch.Tensor, lengths: tuple[int, ...]) -> torch.Tensor:
    model.zero_grad()
    forces, _ = model(frames, lengths=lengths)
    error(forces, torch.zeros_like(forces), lengths).backward()
    return torch.cat([weight.grad.flatten() for weight in model.parameters()])


def test_padding_changes_neither_forces_nor_gradients_nor_statistics() -> None:
    network = ForceNetworkSettings(
        encoder=(4, 4, 8), blocks=1, memory=8, tail=(8, 8), encoder_norm="batch", tail_norm="batch"
    )
    frames = torch.randn(3, 5, 2, 32, 32)
    other = frames.clone()
    other[0, 2:], other[2, 4:] = torch.nan, 1e6
    one, two = _model(network=network), _model(network=network)
    assert torch.equal(_gradients(one, frames, (2, 5, 4)), _gradients(two, other, (2, 5, 4)))
    assert all(torch.equal(a, b) for a, b in zip(one.buffers(), two.buffers(), strict=True))


def test_gradients_of_a_padded_batch_are_those_of_its_sequences() -> None:
    model = _model()
    frames = torch.randn(2, 5, 2, 32, 32)
    batched = _gradients(model, frames, (2, 5))
    alone = [_gradients(model, frames[[row], :n], (n,)) for row, n in ((0, 2), (1, 5))]
    assert torch.allclose(batched, (2 * alone[0] + 5 * alone[1]) / 7, atol=1e-6)


def test_newtons_and_shares_are_inverse() -> None:
    model = _model()
    model.low.copy_(torch.tensor([-4.0, -3.0, -18.0]))
    model.high.copy_(torch.tensor([4.0, 5.0, 1.0]))
    forces = torch.tensor([[0.5, -2.0, -9.0]])
    assert torch.allclose(model.denormalise(model.normalised(forces)), forces)
    assert torch.equal(model.denormalise(torch.ones(3)), model.high)


def test_an_untrained_model_begins_at_the_mean_label() -> None:
    model = _model().eval()
    model.start_at(torch.tensor([0.2, 0.5, 0.9]))
    force, _ = model.step(torch.randn(4, 2, 32, 32))
    assert torch.allclose(force.mean(0), torch.tensor([0.2, 0.5, 0.9]), atol=0.1)


def test_inputs_show_what_they_are_named_for() -> None:
    frames = torch.randint(0, 256, (2, 256, 256), dtype=torch.uint8)
    references = torch.randint(0, 256, (2, 256, 256), dtype=torch.uint8)
    small = frames.float().view(2, 64, 4, 64, 4).mean(dim=(2, 4)) / 255
    image = prepare(frames, None, InputSettings(form="image", side_px=64))
    assert torch.allclose(image[:, 0], small, atol=1e-6)
    both = prepare(frames, references, InputSettings(form="both", side_px=64))
    still = prepare(references, None, InputSettings(form="image", side_px=64))
    assert torch.equal(both, torch.cat((image, image - still), 1))
    colour = prepare(frames, None, InputSettings(form="image", channels=3, imagenet=True))
    assert torch.allclose(colour[:, 1] * 0.224 + 0.456, frames / 255, atol=1e-6)
    field = torch.full((1, 3, 32, 32), 20.0)
    assert prepare(field, None, InputSettings(form="field"))[0, :, 0, 0].tolist() == [2, 2, 20]
    shading = torch.full((1, 3, 128, 128), 144, dtype=torch.uint8)
    found = prepare(shading, None, InputSettings(form="shading", side_px=32, shading_scale=8.0))
    assert (found == 2).all()
    assert found.shape == (1, 3, 32, 32)


def test_a_model_that_judges_frames_alone_forgets_at_every_step() -> None:
    model = _model(input=InputSettings(form="shading", side_px=32, alone=True)).eval()
    frame, other = torch.randn(2, 1, 3, 32, 32)
    with torch.no_grad():
        _, state = model.step(other)
        after, _ = model.step(frame, state)
        fresh, _ = model.step(frame)
    assert torch.equal(after, fresh)
