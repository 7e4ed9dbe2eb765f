"""Ten episodes by `lerobot-record`, loaded by LeRobot, and one training step of a small policy on them."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from daemon_processes import OPEN_MM, EmulatedCell
from lerobot.cameras import CameraConfig
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.robots import RobotConfig
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.utils.import_utils import register_third_party_plugins

EPISODES, FPS = 10, 10
EPISODE_S, RESET_S = 4.5, 0.8
SLIP = [f"slip.{index}{name}" for index in ("", "1.") for name in ("valid", "rotation_deg", "sigma_deg", "age_ms")]
NAMES = ["shoulder.pos", "elbow.pos", "gripper.pos", "grip.force_n", *SLIP]
CHUNK = 8
TIMEOUT_S = 240.0


def test_lerobot_finds_both_packages_by_their_names(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        register_third_party_plugins()
    assert "slipguard" in CameraConfig.get_known_choices()
    assert "slipguard" in RobotConfig.get_known_choices()
    assert "Could not import" not in caplog.text


class Assistant:
    """Places the next object when the jaws have released one."""

    def __init__(self, cell: EmulatedCell) -> None:
        self._cell, self._done = cell, threading.Event()
        self.gripped = self.slipped = 0
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Assistant:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        phase, slipping, placed = "idle", False, True
        while not self._done.wait(0.05):
            state = self._cell.state()
            self.gripped += state["phase"] == "holding" != phase and phase != "fault"
            self.slipped += state["slipping"] and not slipping
            phase, slipping = state["phase"], state["slipping"]
            if phase == "idle" and not placed and state["gripper"]["width_mm"] > OPEN_MM:
                self._cell.order("place wrench 0")
            placed = phase == "idle" and state["gripper"]["width_mm"] > OPEN_MM


@pytest.fixture(scope="module")
def recorded(cell: EmulatedCell, folder: Path) -> Iterator[Path]:
    """The folder of a data set, recorded by LeRobot's own program with a schedule instead of a person."""
    root, period_s = folder / "dataset", EPISODE_S + RESET_S
    cameras = f"{{gel_left: {{type: slipguard, finger: left, max_age_ms: 10000, socket: {cell.socket}}}}}"
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_record", "--robot.discover_packages_path=scripted"),
        *("--robot.type=slipguard", "--robot.arm={type: scripted_arm}", f"--robot.cameras={cameras}"),
        *(
            f"--robot.socket={cell.socket}",
            "--robot.estimates=2",
            "--teleop.type=scripted_person",
            f"--teleop.period_s={period_s}",
        ),
        *("--teleop.closed_s=0.2", f"--teleop.opened_s={EPISODE_S - 0.6}", "--dataset.repo_id=test/gel"),
        *(f"--dataset.root={root}", f"--dataset.fps={FPS}", f"--dataset.num_episodes={EPISODES}"),
        *(f"--dataset.episode_time_s={EPISODE_S}", f"--dataset.reset_time_s={RESET_S}"),
        *("--dataset.single_task=hold it", "--dataset.video=false", "--dataset.push_to_hub=false"),
        *("--dataset.no_stamp=true", "--play_sounds=false"),
    ]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent), "HF_LEROBOT_HOME": str(folder / "lerobot")}
    with Assistant(cell) as assistant, (folder / "record.txt").open("w") as out:
        done = subprocess.run(
            command, env=environment, stdout=out, stderr=out, stdin=subprocess.DEVNULL, timeout=TIMEOUT_S, check=False
        )
    text = (folder / "record.txt").read_text()
    assert done.returncode == 0, text[-3000:]
    assert cell.state()["fault"] is None
    assert assistant.gripped >= EPISODES / 2, "the schedule goes on while an episode is saved"
    assert assistant.slipped, "the robot lifted an object that slips"
    yield root
    with contextlib.suppress(Exception):
        cell.release()


def load(root: Path) -> LeRobotDataset:
    steps = {"action": [index / FPS for index in range(CHUNK)]}
    return LeRobotDataset("test/gel", root=root, delta_timestamps=steps)


def test_lerobots_loader_reads_all_episodes(recorded: Path) -> None:
    dataset = load(recorded)
    assert dataset.num_episodes == EPISODES
    assert dataset.meta.robot_type == "slipguard"
    assert dataset.features["observation.state"]["names"] == NAMES
    assert dataset.features["action"]["names"] == NAMES[:3]
    states = torch.stack(list(dataset.hf_dataset.select_columns("observation.state")["observation.state"]))
    assert states.isfinite().all()
    force_n, valid, sigma_deg = states[:, 3], states[:, 4] > 0.5, states[:, 6]
    assert force_n.min() == 0.0
    assert force_n.max() > 30.0
    assert (~valid).any(), "no estimate while the jaws are open"
    assert (sigma_deg[valid] > 0.0).all()
    assert sigma_deg[valid].median() < 10.0, "an estimate while they hold"
    image = dataset[len(dataset) // 2]["observation.images.gel_left"]
    assert image.shape == (3, 320, 240)
    assert 0.0 < image.mean() < 1.0


def test_one_training_step_of_a_small_policy(recorded: Path) -> None:
    dataset = load(recorded)
    torch.manual_seed(0)
    features = dataset_to_policy_features(dataset.features)
    outputs = {key: one for key, one in features.items() if one.type is FeatureType.ACTION}
    config = ACTConfig(
        input_features={key: one for key, one in features.items() if key not in outputs},
        output_features=outputs,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=64,
        n_heads=2,
        dim_feedforward=64,
        n_encoder_layers=1,
        latent_dim=8,
        n_vae_encoder_layers=1,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    policy = ACTPolicy(config)
    preprocess, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-4)
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=2, shuffle=True)))
    before = policy.model.action_head.weight.detach().clone()
    loss, _ = policy.forward(preprocess(batch))
    loss.backward()
    optimizer.step()
    assert loss.isfinite()
    assert not torch.equal(before, policy.model.action_head.weight)
