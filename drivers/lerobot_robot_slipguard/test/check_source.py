"""Checks camera and robot against LeRobot's source without importing it: for a Python that LeRobot does not run on.

    python check_source.py FOLDER    a folder with `lerobot/`, such as an unpacked wheel

Prints each difference and exits 1: a required method that is missing or has other parameters, and names that LeRobot
would not find.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

DRIVERS = Path(__file__).resolve().parents[2]
CHECKED = (
    ("cameras/camera.py", "Camera", "lerobot_camera_slipguard", "slipguard_camera.py", "SlipguardCamera"),
    ("robots/robot.py", "Robot", "lerobot_robot_slipguard", "slipguard_robot.py", "SlipguardRobot"),
)
"""File and base class of LeRobot; package, file and class of ours."""


def methods(file: Path, name: str) -> dict[str, tuple[list[str], bool]]:
    """Return parameters, and whether it is abstract, of each method of a class."""
    classes = (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ClassDef))
    (found,) = (node for node in classes if node.name == name)
    functions = [one for one in found.body if isinstance(one, ast.FunctionDef)]
    return {one.name: ([arg.arg for arg in one.args.args], _is_abstract(one)) for one in functions}


def _is_abstract(function: ast.FunctionDef) -> bool:
    return any("abstractmethod" in ast.unparse(one) for one in function.decorator_list)


def differences(lerobot: Path) -> list[str]:
    """Return what does not fit LeRobot's source, a line each. lerobot: its package folder."""
    wrong = []
    discovery = (lerobot / "utils" / "import_utils.py").read_text()
    for base_file, base, package, file, name in CHECKED:
        required, own = methods(lerobot / base_file, base), methods(DRIVERS / package / package / file, name)
        for method, (parameters, abstract) in required.items():
            if method not in own:
                wrong += [f"{name}.{method} is missing"] if abstract else []
            elif own[method][0][: len(parameters)] != parameters:
                wrong.append(f"{name}.{method} has the parameters {own[method][0]}; LeRobot calls it with {parameters}")
        if f'"{package.removesuffix("slipguard")}"' not in discovery:
            wrong.append(f"LeRobot does not discover packages by the name {package}")
        init = (DRIVERS / package / package / "__init__.py").read_text()
        wrong += [f"{package} does not export {one}" for one in (name, f"{name}Config") if f'"{one}"' not in init]
    if 'config_name.endswith("Config")' not in discovery or "device_class_name = config_name[:-6]" not in discovery:
        wrong.append("LeRobot derives the class from the configuration's name in another way")
    return wrong


if __name__ == "__main__":
    found = differences(Path(sys.argv[1]) / "lerobot")
    print("\n".join(found) or "camera and robot fit LeRobot's source")
    sys.exit(bool(found))
