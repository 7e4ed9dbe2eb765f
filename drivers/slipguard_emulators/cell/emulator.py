"""A whole cell in one process: one world behind two cameras, a gripper on a serial port and a robot controller."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import DriverContext
from slipguard.emulator import Event, Report
from slipguard.errors import CommandRefused, InputError, SlipguardError
from slipguard.registry import load_driver
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import CameraModel, scenario
from slipguard.sim.world import World, WorldSettings
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.cell.cell_config import CellPaths, config_text
from slipguard_emulators.cell.frame_server import FrameServer
from slipguard_emulators.cell.lift_program import LiftProgram
from slipguard_emulators.cell.truth_log import CellTruthLog, line_of
from slipguard_emulators.cell.world_jaws import WorldJaws
from slipguard_emulators.robotiq.emulator import FAULTS as GRIPPER_FAULTS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.ur5.controller import PAUSED, POWER_OFF
from slipguard_emulators.ur5.emulator import UrEmulator
from slipguard_emulators.ur5.faults import FAULTS as ARM_FAULTS
from slipguard_emulators.ur5.tool import WorldTool

FINGERS = ("left", "right")
CAMERA_FAULTS = {
    "disconnect": "the camera is unplugged",
    "stall": "no frames come",
    "frozen": "the same image is repeated",
    "tear": "frames have a part of the previous image; with a probability, such as `fault left.tear 0.05`",
    "corrupt": "frames come damaged",
}
POLL_S = 0.05
GRIP_MIN_N = 10.0
"""From this force on, the robot's program treats the object as gripped."""
REPORTED = frozenset({"gripped", "tightened", "released", "paused", "resumed", "started", "ended", "safety", "fault"})
"""Events of the parts that are reported; their logs have all events."""


class CellWorld(World):
    """A world with a given camera rate, whose gripper reacts at once: the serial line has its own delays."""

    def __init__(self, seed: int, fps: float, fingertip_mm: float = 0.0) -> None:
        gripper = GripperDynamics(transaction_s=0.0)
        super().__init__(WorldSettings(gripper=gripper, fingertip_mm=fingertip_mm), seed)
        self._fps = fps
        self.tears: dict[str, float] = {}
        """Share of torn frames by finger."""

    def camera(self, finger: str) -> CameraModel:
        """Return the camera model with the given rate."""
        return replace(super().camera(finger), fps=self._fps, tear_probability=self.tears.get(finger, 0.0))


class CellEmulator(ControlledEmulator):
    """Emulate a whole cell: cameras, gripper, robot and an object that would slip; log what really happens.

    Writes a configuration for `slipguard run` into the folder. Faults start with the device's name: `fault gripper.late
    0.01`, `fault left.stall`. Further commands: `place NAME [SEED]`, `take`, `gripper COMMAND`, `arm COMMAND`.

    Example: `slipguard emulate cell --folder cell --object wrench`, then `slipguard run --config cell/config.toml`
    """

    class Settings(BaseModel):
        """The command's options."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        folder: Annotated[Path, Field(description="Folder for sockets, port, configuration and log.")] = Path("cell")
        object: Annotated[str, Field(description="Object between the jaws; `none` for no object.")] = "wrench"
        seed: Annotated[int, Field(ge=0, description="Random seed.")] = 0
        mode: Annotated[
            Literal["lift", "guard"],
            Field(description="lift: slipguard moves the arm; guard: the robot's own program does."),
        ] = "lift"
        host: Annotated[str, Field(description="Address of this machine for the robot.")] = "127.0.0.1"
        gripper: Annotated[
            Literal["usb", "forwarder", "urcap"],
            Field(description="Gripper on a serial port, the robot's RS-485 forwarder, or Robotiq's URCap."),
        ] = "usb"
        series: Annotated[Literal["e", "cb3"], Field(description="Robot: cb3 125 Hz, e 500 Hz.")] = "cb3"
        fingertip_mm: Annotated[
            float, Field(ge=0.0, le=40.0, description="Thickness of each sensor: the gels meet that early.")
        ] = 0.0
        activated: Annotated[
            bool, Field(description="The gripper is activated; default: as after power-on (`slipguard ctl activate`).")
        ] = False
        gripper_power: Annotated[
            Literal["own", "wrist"],
            Field(
                description="Its 24 V: an own supply, or the robot's wrist, where they are off while the arm is off, "
                "also in an emergency stop."
            ),
        ] = "own"
        robot_on: Annotated[
            bool,
            Field(description="The robot is switched on, in remote control; default: off (`arm panel on`)."),
        ] = False
        mounting_deg: Annotated[
            float,
            Field(ge=0.0, le=180.0, description="Tilt of the robot: 0 upright, 90 on a wall, 180 on the ceiling."),
        ] = 0.0
        fps: Annotated[
            Literal["60", "30"], Field(description="Rate of the cameras; rendering at 60 takes half a core.")
        ] = "60"
        baud: Annotated[int, Field(ge=0, description="Baud rate of the serial line; 0: no delay.")] = 115200
        height_mm: Annotated[float, Field(ge=1.0, le=800.0, description="Height of a lift.")] = 150.0
        speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0, description="Speed of a lift.")] = 80.0
        play_again_s: Annotated[
            float,
            Field(ge=0.0, le=600.0, description="Guard mode: a paused program continues after this time; 0: never."),
        ] = 2.0

    def __init__(self, settings: Settings, report: Report | None = None) -> None:
        super().__init__(_fault_names(), settings.seed, report)
        self.settings = settings
        self.places = CellPaths(settings.folder.resolve())
        self.world = CellWorld(settings.seed, float(settings.fps), settings.fingertip_mm)
        self.tool = WorldTool(self.world)
        self.gripper = RobotiqEmulator(
            RobotiqEmulator.Settings(
                wiring=settings.gripper,
                host=settings.host,
                link=self.places.gripper if settings.gripper == "usb" else None,
                activated=settings.activated,
                baud=settings.baud,
                seed=settings.seed,
            ),
            self._part("gripper"),
            WorldJaws(self.world),
        )
        arm_settings = UrEmulator.Settings.model_validate(
            {
                "host": settings.host,
                "series": settings.series,
                "ready": settings.robot_on,
                "mounting_deg": settings.mounting_deg,
            }
        )
        self.arm = UrEmulator(arm_settings, self._part("arm"), tool=self.tool)
        self.cameras = {name: self._camera(name) for name in FINGERS}
        self.program = self._new_program()
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def address(self) -> str:
        """Path of the configuration for `slipguard run`."""
        return str(self.places.config)

    async def start(self) -> None:
        """Create folder, object, cameras, gripper and robot. Raises InputError."""
        settings = self.settings
        self.places.make()
        self.world.truth(_now_s())
        if settings.object != "none":
            self._place(settings.object, settings.seed)
        for camera in self.cameras.values():
            camera.plug()
        await self.gripper.start()
        await self.arm.start()
        self._power_gripper()
        self.places.config.write_text(
            config_text(
                self.places,
                gripper=self.gripper.driver_settings,
                mode=settings.mode,
                host=settings.host,
                height_mm=settings.height_mm,
                speed_mm_s=settings.speed_mm_s,
            )
        )
        log = CellTruthLog(self.world, self.places.truth, lambda why: self.note("dropped", why=why))
        self._tasks = [asyncio.create_task(log.run(), name="truth")]
        if settings.mode == "guard":
            self.arm.controller.loaded = self._new_program
            self._tasks.append(asyncio.create_task(self._operate_panel(), name="panel"))

    async def stop(self) -> None:
        """Disappear; configuration and log stay."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []
        for camera in self.cameras.values():
            await camera.close()
        await self.gripper.stop()
        await self.arm.stop()

    def state(self) -> Mapping[str, object]:
        """Return the true state."""
        shown = {key: value for key, value in line_of(self.world.truth(_now_s())).items() if key != "t"}
        shown["jaws_mm"] = round(self.world.gripper_state(_now_s()).width_mm, 1)
        shown["robot"] = self.arm.state()["runtime"]
        if self.settings.mode == "guard":
            shown["program"] = self.program.stage.value
        shown["watched"] = ", ".join(name for name, one in self.cameras.items() if one.read) or "no client"
        shown["faults"] = ", ".join(self._active()) or "none"
        return shown

    def commands(self) -> dict[str, EmulatorCommand]:
        """Return the commands for the object and the parts."""
        return {
            "place": (self._place_word, "place NAME [SEED]: place an object between the open jaws"),
            "take": (self._take, "take: remove the object"),
            "gripper": (self._pass_on(self.gripper), "gripper COMMAND: to the gripper, such as `gripper log 3`"),
            "arm": (self._pass_on(self.arm), "arm COMMAND: to the robot, such as `arm panel pause`"),
        }

    # Faults of the parts.

    def set_fault(self, name: str, amount: float | int | None = None) -> None:
        """Start the fault `PART.FAULT`. Raises CommandRefused."""
        self.faults.check(name)
        part, kind = name.split(".")
        if part not in FINGERS:
            emulator = self.gripper if part == "gripper" else self.arm
            emulator.set_fault(kind, amount)
            return
        if kind == "tear":
            if isinstance(amount, int) or not 0.0 <= (amount or 0.0) <= 1.0:
                raise CommandRefused(f"{name}: {amount} is not a probability; it must be 0.0 to 1.0")
            self.world.tears[part] = 1.0 if amount is None else amount
            return
        if amount is not None:
            raise CommandRefused(f"{name}: a camera fails until cleared; give neither probability nor count")
        self.world.faults.fail(part, kind)
        if kind == "disconnect":
            self.cameras[part].unplug()

    def clear_fault(self, name: str | None = None) -> None:
        """End one fault, or all. Raises CommandRefused."""
        if name is None:
            self.world.tears.clear()
            for part in FINGERS:
                self.world.faults.repair(part)
                self.cameras[part].plug()
            self.gripper.clear_fault()
            self.arm.clear_fault()
            return
        self.faults.check(name)
        part, kind = name.split(".")
        if part not in FINGERS:
            (self.gripper if part == "gripper" else self.arm).clear_fault(kind)
            return
        if kind == "tear":
            self.world.tears.pop(part, None)
            return
        self.world.faults.repair(part, kind)
        if kind == "disconnect":
            self.cameras[part].plug()

    def _active(self) -> list[str]:
        cameras = [f"{part}.{kind}" for part in FINGERS for kind in sorted(self.world.faults.active(part))]
        cameras += [f"{part}.tear" for part in self.world.tears]
        parts = (("gripper", self.gripper), ("arm", self.arm))
        return cameras + [f"{part}.{kind}" for part, emulator in parts for kind in emulator.faults.active]

    # The object.

    def _place(self, name: str, seed: int) -> None:
        try:
            grasp = scenario(name, seed)
            self.world.place(replace(grasp, gripper=replace(grasp.gripper, transaction_s=0.0)), _now_s())
        except InputError:
            raise
        except SlipguardError as error:
            raise CommandRefused(str(error)) from None
        self.note("placed", object=name, seed=seed)

    def _place_word(self, rest: list[str]) -> str:
        if len(rest) not in (1, 2) or not all(word.isdecimal() for word in rest[1:]):
            raise CommandRefused("write `place NAME [SEED]`, such as `place wrench 3`")
        try:
            self._place(rest[0], int(rest[1]) if len(rest) == 2 else self.settings.seed)
        except InputError as error:
            raise CommandRefused(str(error)) from None
        return f"{rest[0]} lies between the jaws"

    def _take(self, rest: list[str]) -> str:
        self.world.clear(_now_s())
        return "nothing between the jaws"

    # The parts.

    def _camera(self, name: str) -> FrameServer:
        simulated = load_driver("slipguard.tactile", "fake")
        settings = simulated.Settings.model_validate({"draw": "process", "stall_ms": 500})
        sensor = simulated(settings, DriverContext(name, self.world))
        return FrameServer(self.places.camera(name), sensor, float(self.settings.fps))

    def _new_program(self) -> LiftProgram:
        def held() -> bool:
            now_s = _now_s()
            truth = self.world.truth(now_s)
            return truth.in_contact and truth.force_n > GRIP_MIN_N and not self.world.gripper_state(now_s).moving

        settings = self.settings
        self.program = LiftProgram(
            self.tool, held, height_m=settings.height_mm / 1000.0, speed_m_s=settings.speed_mm_s / 1000.0
        )
        return self.program

    async def _operate_panel(self) -> None:
        """Start the robot's own program as soon as it is switched on, and continue it some time after it was paused."""
        controller, wait_s = self.arm.controller, self.settings.play_again_s
        started = False
        paused_s: float | None = None
        while True:
            started = started or controller.play(_now_s())
            await asyncio.sleep(POLL_S)
            if controller.runtime != PAUSED:
                paused_s = None
            elif paused_s is None:
                paused_s = _now_s()
            elif wait_s and _now_s() - paused_s >= wait_s:
                controller.play(_now_s())

    def _part(self, name: str) -> Report:
        def log_event(event: Event) -> None:
            entry = {"at_s": event["at_s"], "part": name, **event}
            self.log.append(entry)
            if self._report is not None and event["event"] in REPORTED:
                self._report(entry)
            if name == "arm" and event["event"] == "robot mode":
                self._power_gripper()

        return log_event

    def _power_gripper(self) -> None:
        """Let the 24 V at the wrist follow the arm's power, if the gripper has it from there."""
        if self.settings.gripper_power == "own":
            return
        powered = self.arm.controller.mode != POWER_OFF
        if not powered:
            self.gripper.set_fault("power")
        elif self.gripper.faults.lasts("power"):
            self.gripper.clear_fault("power")

    def _pass_on(self, part: ControlledEmulator) -> Callable[[list[str]], str]:
        return lambda rest: part.control(" ".join(rest or ["help"]))


def _fault_names() -> dict[str, str]:
    cameras = {f"{part}.{kind}": text for part in FINGERS for kind, text in CAMERA_FAULTS.items()}
    gripper = {f"gripper.{kind}": text for kind, text in GRIPPER_FAULTS.items()}
    return cameras | gripper | {f"arm.{kind}": text for kind, text in ARM_FAULTS.items()}


def _now_s() -> float:
    return asyncio.get_running_loop().time()
