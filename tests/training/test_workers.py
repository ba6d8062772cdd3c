import json
import os
import signal
from pathlib import Path

from tests.support.command_line import TINY
from tests.support.forked import start_fork

TWO = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]


def test_killed_worker_ends_run_as_interrupted(tmp_path):
    settings = ["learn=task", "trainer.max_epochs=1000", "val_fraction=0", "hydra.run.dir=run"]
    process = start_fork([*TINY[1:], *TWO, *settings], tmp_path)
    for line in process.stdout:
        if line.startswith("epoch 1/"):
            break
    (worker,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    os.kill(int(worker), signal.SIGKILL)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 130
    assert err.count("\n") == 1
    assert "Worker process 1 was killed (signal 9)" in err
    assert "ckpt_path=last" in err
    record = json.loads((tmp_path / "run" / "result.json").read_text())
    assert record["status"] == "interrupted"
