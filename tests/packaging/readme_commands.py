"""Which test executes which command of the README. A command without an entry here fails the tests.

A key is the command without its options: `slipguard emulate cell --folder cell` is "emulate cell", the plain
`slipguard --sim` is "--sim". Other programs' commands are found by how they begin.
"""

from __future__ import annotations

CELL = "tests/wire/test_cell_commands.py::test_every_command_of_a_guarded_cell"

EXECUTED = {
    "--sim": "tests/unit/test_cli_sim.py::test_one_lift_for_a_program",
    "run": CELL,
    "check": CELL,
    "doctor": "tests/wire/test_doctor.py::test_all_present",
    "install": "tests/unit/test_install.py",
    "calibrate": CELL,
    "ctl state": CELL,
    "ctl grasp": CELL,
    "ctl lift": CELL,
    "ctl lower": CELL,
    "ctl guard": CELL,
    "ctl gripper": CELL,
    "ctl release": CELL,
    "ctl clear": CELL,
    "ctl calibrate": CELL,
    "ctl page": CELL,
    "measure": "tests/unit/test_measure.py::test_a_turn_is_read_with_sign_and_every_key",
    "replay": CELL,
    "bench": "tests/unit/test_bench_command.py::test_a_short_one",
    "latency": "tests/wire/test_latency_command.py::test_a_short_one",
    "stress": "tests/unit/test_stress.py::test_the_command_prints_json_and_writes_the_picture",
    "soak": "tests/loop/test_soak.py::test_a_short_one_with_the_page_open",
    "turned": "tests/unit/test_turned.py::test_the_command_gives_both_ways",
    "evaluate run": "tests/loop/test_evaluate_run.py::test_what_is_done_is_not_done_again",
    "evaluate report": "tests/loop/test_evaluate_run.py::test_what_is_done_is_not_done_again",
    "evaluate turn": "tests/unit/test_evaluate_files.py::test_a_film_tells_the_turn",
    "evaluate markers": "tests/unit/test_evaluate_files.py::test_sheets_are_at_true_scale",
    "evaluate calibrate-camera": "tests/unit/test_evaluate_files.py::test_a_board_tells_the_lens",
    "dataset render": "tests/unit/test_dataset.py::test_the_command_writes_a_data_set",
    "dataset import": "tests/unit/test_dataset_import.py::test_the_commands_import_and_show",
    "dataset record": CELL,
    "dataset show": CELL,
    "train": "tests/unit/test_paper_networks.py",
    "emulate robotiq": "tests/wire/test_emulate_command.py::test_a_program_starts_it_talks_to_it_and_ends_it",
    "emulate cell": CELL,
    "emulate digit": "tests/wire/test_emulate_command.py::test_a_person_ends_it_without_a_traceback",
    "emulate ur": "tests/wire/test_ur_campaign.py",
    "version": "tests/packaging/test_wheel.py::test_version_and_check",
}
"""slipguard's own."""

OTHERS = {
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/slipguard --sim": "tests/packaging/test_wheel.py",
    "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest": ".ci/run",
    "pip install 'slipguard[": "tests/packaging/test_readme.py",
    "pytest tests/contract/test_sensor_contract.py -k driver": "tests/packaging/test_third_party_driver.py",
    "pytest tests/contract --digit": "tests/contract/conftest.py",
    "pytest tests/wire/test_robotiq_campaign.py": "tests/wire/test_robotiq_campaign.py",
    "pytest tests/wire/test_ur_campaign.py": "tests/wire/test_ur_campaign.py",
    "pytest tests/wire/test_kill_campaign.py": "tests/wire/test_kill_campaign.py",
    "mutmut ": "pyproject.toml",
    "pytest tests/browser/test_page_looks.py": "tests/browser/test_page_looks.py",
    "pytest tests/vm": "tests/vm/test_digit_on_linux.py",
    "python tests/vm/build_image.py": "tests/vm/machine.py",
    "python3 slipguard_bridge.py": "tests/packaging/test_ros2_bridge.py",
    "ros2 service call": "tests/packaging/test_ros2_bridge.py",
    "ros2 topic echo": "tests/packaging/test_ros2_bridge.py",
    "systemctl": "tests/service/test_service.py",
    "journalctl -u slipguard": "tests/service/test_service.py",
    "python tests/service/build_root.py": "tests/service/conftest.py",
    "sudo python3 -m venv /opt/slipguard": "tests/service/build_root.py",
    "sudo /opt/slipguard/bin/slipguard install": "tests/service/test_service.py",
    "usbip attach": "tests/wire/test_digit_usbip.py",
    "apt-get install git python3-venv": ".ci/run",
    ".ci/run": ".ci/run",
}
"""Of other programs: how the line begins, and what does the same here.

A package manager, a robot's network and a kernel are not at hand in the tests: ROS is stood in for, the kernel is
that of the test machine, and apt's packages are what the gate itself needs.
"""
