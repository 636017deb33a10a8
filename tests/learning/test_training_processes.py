"""Distributed training: two processes with half a batch each equal one with the full batch."""

from pathlib import Path

import pytest
import torch
from support.commands import python

from learning.training.checkpoint import read_model_folder

SCRIPT = """
import sys
from dataclasses import dataclass
import torch
from torch import nn
from learning.training.run import LaunchSettings, RunFolder, Stop, accelerator, described
from learning.training.run import batch, generator, seed_torch

@dataclass(frozen=True)
class Toy:
    batch: int

folder, whole, stop_at = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
launched = accelerator(LaunchSettings(device="cpu"))
print(described(launched), flush=True)
rank, ranks = launched.process_index, launched.num_processes
values = torch.from_numpy(generator(0, "values").normal(size=(24, 3))).float()
seed_torch(0, "weights")
net = nn.Linear(3, 1)
optimiser = torch.optim.SGD(net.parameters(), lr=0.1)
wrapped, optimiser = launched.prepare(net, optimiser)
stop = Stop()
run = RunFolder.open(folder, "force", Toy(whole), "data", writes=launched.is_main_process)
for step in range(20):
    chosen = batch(0, step, whole // ranks, len(values), rank=rank, ranks=ranks)
    seen = values[torch.from_numpy(chosen)]
    loss = (wrapped(seen) - seen.sum(1, keepdim=True)).square().mean()
    optimiser.zero_grad()
    launched.backward(loss)
    optimiser.step()
    run.log(step + 1, {"loss": loss.item()})
    # The last process alone is asked; all of them stop.
    stop.requested = stop.requested or (rank == ranks - 1 and step == stop_at)
    if stop.agreed(launched):
        break
run.finish(step + 1, {"model": launched.unwrap_model(wrapped)})
launched.end_training()
"""


def _run(path: Path, folder: Path, processes: int, stop_at: int) -> str:
    path.write_text(SCRIPT)
    many = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    arguments = [*(many if processes > 1 else []), str(path), str(folder), "8", str(stop_at)]
    return python(*arguments, OMP_NUM_THREADS="1").stdout


@pytest.mark.slow
def test_two_processes_learn_and_stop_as_one(tmp_path: Path) -> None:
    assert "2 processes, cpu" in _run(tmp_path / "toy.py", tmp_path / "two", 2, 11)
    _run(tmp_path / "toy.py", tmp_path / "one", 1, 11)
    folders = [read_model_folder(tmp_path / name, "force") for name in ("one", "two")]
    assert [folder.config.step for folder in folders] == [12, 12]
    one, two = (folder.weights() for folder in folders)
    for name, value in one.items():
        assert torch.allclose(value, two[name], atol=1e-6), name
    assert len((tmp_path / "two/metrics.jsonl").read_text().splitlines()) == 12
