"""Record an episode in a simulated cell with the guard and one without it, and plot both.

    python -m lerobot_robot_slipguard.demo SLIPGUARD FOLDER

FOLDER receives both data sets, `guarded` and `unguarded`, and `slip.png`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDataset
from slipguard_demo import EmulatedCell, plot

FPS, EPISODE_S = 20, 9.0
RECORD = (
    "--robot.type=slipguard --teleop.type=slipguard_demo_person --dataset.num_episodes=1 --dataset.push_to_hub=false "
    f"--dataset.fps={FPS} --dataset.episode_time_s={EPISODE_S} --dataset.reset_time_s=0 --dataset.video=false "
    "--dataset.no_stamp=true --play_sounds=false"
)


def record(cell: EmulatedCell, root: Path, guarded: bool) -> None:
    """Record one episode with LeRobot's own program. Raises SystemExit if that fails."""
    camera = f"{{gel_left: {{type: slipguard, finger: left, max_age_ms: 5000, socket: {cell.socket}}}}}"
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_record", *RECORD.split(), f"--robot.socket={cell.socket}"),
        *(f"--robot.arm={{type: slipguard_demo_arm, socket: {cell.socket}}}", f"--robot.cameras={camera}"),
        *(f"--dataset.repo_id=demo/{root.name}", f"--dataset.root={root}", "--dataset.single_task=hold it"),
    ]
    with (root.parent / f"{root.name}.txt").open("w") as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=os.environ | {"HF_HUB_OFFLINE": "1"}
        )
        cell.wait_for("holding", within_s=120.0)
        cell.api.submit("guard", {"on": guarded})  # the cell's robot lifts 1.5 s after the grip
        if process.wait(120.0) != 0:
            raise SystemExit(f"lerobot-record failed; see {log.name}")


def curves(root: Path) -> dict[str, list[tuple[float, float]]]:
    """Return rotation and force of a data set, read by LeRobot's loader."""
    dataset = LeRobotDataset(f"demo/{root.name}", root=root)
    names = dataset.features["observation.state"]["names"]
    rows = dataset.hf_dataset.select_columns(["timestamp", "observation.state"])
    times = torch.stack(list(rows["timestamp"])).flatten().tolist()
    states = torch.stack(list(rows["observation.state"]))
    valid, rotation, force = (
        states[:, names.index(name)].tolist() for name in ("slip.valid", "slip.rotation_deg", "grip.force_n")
    )
    measured = [(at_s, value) for at_s, value, is_valid in zip(times, rotation, valid, strict=True) if is_valid]
    return {"rotation [deg]": measured, "grip force [N]": [*zip(times, force, strict=True)]}


def main() -> int:
    """Record both episodes and write the plot; return the exit status."""
    if len(sys.argv) != 3:
        print("usage: python -m lerobot_robot_slipguard.demo SLIPGUARD FOLDER", file=sys.stderr)
        return 2
    program, folder = sys.argv[1], Path(sys.argv[2])
    folder.mkdir(parents=True)
    episodes = {}
    with EmulatedCell([program], folder / "cell", mode="guard") as cell:
        for title in ("guarded", "unguarded"):
            record(cell, folder / title, title == "guarded")
            cell.release()
            episodes[title] = curves(folder / title)
            largest_deg = max(abs(value) for _, value in episodes[title]["rotation [deg]"])
            print(f"{title}: rotation up to {largest_deg:.1f} deg, data set in {folder / title}")
    plot(episodes, str(folder / "slip.png"))
    print(f"plot: {folder / 'slip.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
