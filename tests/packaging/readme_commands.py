"""Which test executes which command of the README. A command without an entry here fails the tests.

A key is the command without its options: `slipguard emulate cell --folder cell` is "emulate cell", the plain
`slipguard --sim` is "--sim". OPTIONS has what those tests leave to others, OTHERS other programs' lines as they stand.
"""

from __future__ import annotations

CELL = "tests/wire/test_cell_commands.py::test_every_command_of_a_guarded_cell"

RIG = "tests/wire/cell_rig.py"
CALIBRATE = "tests/unit/test_cli_calibrate.py"
SHORT = "tests/packaging/test_readme_options.py"

EXECUTED = {
    "--sim": "tests/unit/test_cli_sim.py::test_one_lift_for_a_program",
    "run": f"{RIG}::daemon",
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
    "measure": f"{SHORT}::test_measure_draws_what_it_measured",
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
    "emulate cell": f"{RIG}::cell",
    "emulate digit": "tests/wire/test_emulate_command.py::test_a_person_ends_it_without_a_traceback",
    "emulate ur": "tests/wire/test_ur_campaign.py",
    "version": "tests/packaging/test_wheel.py::test_version_and_check",
}
"""slipguard's own."""

OPTIONS = {
    "latency --as-service": "tests/unit/test_priority.py::test_where_it_is_refused_it_says_what_to_do",
    "soak --as-service": "tests/unit/test_priority.py::test_where_it_is_refused_it_says_what_to_do",
    "run --sim": "tests/unit/test_cli_interrupt.py",
    "ctl --socket": CELL,
    "ctl --url": "tests/unit/test_ctl.py",
    "calibrate --force": CALIBRATE,
    "calibrate --new-gel": CALIBRATE,
    "calibrate --show": CALIBRATE,
    "calibrate --plot": CALIBRATE,
    "calibrate --back-to": CALIBRATE,
    "calibrate --finger": CALIBRATE,
    "calibrate --json": CALIBRATE,
    "replay --against": SHORT,
    "replay --model": SHORT,
    "bench --grip": "tests/loop/test_fault_campaign.py",
    "bench --faults": "tests/loop/test_fault_campaign.py",
    "bench --seed": "tests/loop/test_fault_campaign.py",
    "bench --jobs": "tests/loop/test_fault_campaign.py",
    "bench --full": SHORT,
    "bench --models": SHORT,
    "bench --table": SHORT,
    "bench --cluster": SHORT,
    "soak --clock": SHORT,
    "evaluate run --config": SHORT,
    "evaluate run --camera": SHORT,
    "evaluate run --intrinsics": SHORT,
    "dataset render --cluster": SHORT,
    "dataset import --skip": SHORT,
    "dataset record --serial": "tests/unit/test_running_socket.py",
    "emulate cell --object": SHORT,
    "emulate cell --mode": SHORT,
    "emulate cell --fault": SHORT,
    "emulate digit --serial": SHORT,
    "emulate digit --pixels": SHORT,
    "emulate digit --fault": SHORT,
    "emulate digit --json": SHORT,
    "emulate ur --fault": SHORT,
}
"""Options that another test uses than the one named above; an option of `ctl` itself stands before its command."""

SERVICE = "tests/service/test_service.py"
BRIDGE = "tests/packaging/test_ros2_bridge.py"
MINI = '{"serial": "M1"}'
OTHERS = {
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/slipguard --sim": (
        "tests/packaging/test_wheel.py",
        '"-m", "slipguard", "--sim"',
    ),
    "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest": (
        ".ci/run",
        "-m pip install --quiet --editable '.[test]'",
    ),
    "pip install 'slipguard[train]'": ("tests/packaging/test_readme.py", 'PROJECT["optional-dependencies"]'),
    f"pytest tests/contract/test_sensor_contract.py -k driver --sensor-driver mini --sensor-settings '{MINI}'": (
        "tests/packaging/test_third_party_driver.py",
        f""""--sensor-driver", "mini", "--sensor-settings", '{MINI}'""",
    ),
    "pytest tests/contract --digit D20479 --gripper /dev/ttyUSB0 --arm 192.0.2.10": (
        "tests/contract/sensor_rigs.py",
        'getoption("--digit")',
    ),
    "pytest tests/wire/test_robotiq_campaign.py --commands 10000": (
        "tests/wire/test_robotiq_campaign.py",
        'getoption("--commands")',
    ),
    "pytest tests/wire/test_ur_campaign.py --arm-campaign 100": (
        "tests/wire/test_ur_campaign.py",
        'getoption("--arm-campaign")',
    ),
    "pytest tests/real/test_false_turns.py -s": ("tests/real/test_false_turns.py", "pytest.mark.real"),
    "pytest tests/wire/test_kill_campaign.py --kills 100 -s": (
        "tests/wire/test_kill_campaign.py",
        'getoption("--kills")',
    ),
    "mutmut run": ("pyproject.toml", "[tool.mutmut]"),
    "mutmut results": ("pyproject.toml", "[tool.mutmut]"),
    "pytest tests/browser/test_page_looks.py --page-pictures DIR": (
        "tests/browser/conftest.py",
        'getoption("--page-pictures")',
    ),
    "pytest tests/vm": ("tests/vm/test_digit_on_linux.py", "pytest.mark.vm"),
    "python tests/vm/build_image.py --install": (".ci/run", "tests/vm/build_image.py --install"),
    "python3 slipguard_bridge.py --ros-args -p socket:=/run/slipguard/slipguard.sock": (BRIDGE, "PARAMETERS"),
    'ros2 service call /slipguard/guard std_srvs/srv/SetBool "{data: true}"': (BRIDGE, '"SetBool"'),
    "ros2 topic echo /slipguard/fault": (BRIDGE, '"~/fault"'),
    "sudo systemctl enable --now slipguard": (SERVICE, 'container.systemctl("start")'),
    "sudo systemctl reload slipguard": (SERVICE, 'container.systemctl("reload")'),
    "sudo systemctl restart slipguard": (SERVICE, 'container.systemctl("start")'),
    "systemctl status slipguard": (SERVICE, '"systemctl", "status"'),
    "journalctl -u slipguard": (SERVICE, '"journalctl", "--no-pager", "--unit", UNIT'),
    "python tests/service/build_root.py --install": (".ci/run", "tests/service/build_root.py --install"),
    "sudo python3 -m venv /opt/slipguard && sudo /opt/slipguard/bin/pip install .": (
        "tests/service/conftest.py",
        'Path(PROGRAM).with_name("pip")',
    ),
    "usbip attach -r 127.0.0.1 -b 1-1": ("tests/wire/test_digit_usbip.py", "attached"),
    "apt-get install git python3-venv": (".ci/run", "apt-get install"),
    ".ci/run": (".ci/run", "pytest"),
}
"""Of other programs: the line, the file where the same is done, and the words there that do it.

A package manager, a robot's network and a kernel are not at hand in the tests: ROS is stood in for, the kernel is
that of the test machine, and apt's packages are what the gate itself needs.
"""
