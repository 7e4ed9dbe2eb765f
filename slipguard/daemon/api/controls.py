"""What people and programs may do with the running service: one method a command, and one snapshot of everything."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.snapshot import snapshot, trouble
from slipguard.daemon.loop.finger import Finger
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.calibration import (
    TIMEOUT_S,
    BackgroundArchive,
    BackgroundImage,
    average_background,
    collect,
)
from slipguard.devices import Frame
from slipguard.errors import CommandRefused, InputError, SlipguardError


class Controls:
    """Every method answers with one line; raises CommandRefused with the reason."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._calibrating = asyncio.Lock()

    def snapshot(self) -> dict[str, object]:
        """Everything there is to know now; does not wait."""
        return snapshot(self._service)

    def trouble(self) -> str | None:
        """Why the service is not well, in one line; None if it is."""
        return trouble(self._service)

    def frame(self, finger: str) -> tuple[str, Frame]:
        """Serial number and newest frame of a finger."""
        fingers = self._service.fingers
        if finger not in fingers:
            raise CommandRefused(f"no finger {finger!r}; there are: {', '.join(fingers)}")
        one = fingers[finger]
        if one.newest_frame is None or one.serial is None:
            raise CommandRefused(f"no frame of the {finger} finger: {one.health.reason}")
        return one.serial, one.newest_frame

    async def grasp(self, force_n: float | None = None) -> str:
        """Close on what is between the jaws. Needs all devices and both no-contact images."""
        waiting = self._service.waiting_for
        if waiting:
            raise CommandRefused(f"cannot grasp: not ready: {'; '.join(waiting)}")
        self._check_calibration_is_over()
        for name, finger in self._service.fingers.items():
            try:
                calibrated = await self._calibrated(finger)
            except InputError as error:
                raise CommandRefused(f"cannot grasp: {error}") from None
            if not calibrated:
                raise CommandRefused(
                    f"cannot grasp: {name} finger ({finger.serial}) has no no-contact image; run `slipguard calibrate`"
                )
        return await self._ask(ControlRequest(RequestKind.GRASP, force_n=force_n))

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        """Lift what is held."""
        return await self._ask(ControlRequest(RequestKind.LIFT, height_mm=height_mm, speed_mm_s=speed_mm_s))

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        """Lower it again; by what it was lifted where no height is given."""
        return await self._ask(ControlRequest(RequestKind.LOWER, height_mm=height_mm, speed_mm_s=speed_mm_s))

    async def guard(self, on: bool) -> str:
        """Act on slip, or only watch."""
        return await self._ask(ControlRequest(RequestKind.GUARD_ON if on else RequestKind.GUARD_OFF))

    async def gripper(self, width_mm: float | None, force_n: float | None) -> str:
        """Move the jaws for another program; never opens a held object and never lowers its grip."""
        self._check_calibration_is_over()
        return await self._ask(ControlRequest(RequestKind.GRIPPER, width_mm=width_mm, force_n=force_n))

    async def release(self, width_mm: float | None = None) -> str:
        """Open the jaws, in every state."""
        return await self._ask(ControlRequest(RequestKind.RELEASE, width_mm=width_mm))

    async def clear(self) -> str:
        """Leave a fault whose cause is gone."""
        return await self._ask(ControlRequest(RequestKind.CLEAR))

    async def calibrate(self, *, force: bool = False, new_gel: bool = False) -> dict[str, BackgroundImage]:
        """Take and store both fingers' no-contact images. Refused while anything is or may be touched.

        force: also where a stored image says that there is contact (its light may have changed). new_gel: the gels have
        been replaced; wear is counted from now on.
        """
        self._check_calibration_is_over()
        async with self._calibrating:
            self._check_idle()
            for name, finger in self._service.fingers.items():
                newest = finger.newest
                if newest is not None and newest.estimate.contact and not force and await self._knows_contact(finger):
                    raise CommandRefused(
                        f"cannot calibrate: {name} finger is in contact; take the object away, or use --force "
                        "if the light has changed"
                    )
            return await self._take(new_gel)

    async def go_back(self, name: str, number: int) -> str:
        """Put an older no-contact image of a finger's sensor to use again. Refused while anything may be touched."""
        finger, store = self._service.fingers.get(name), self._service.store
        if finger is None:
            raise CommandRefused(f"no finger {name!r}; there are: {', '.join(self._service.fingers)}")
        if finger.serial is None or not isinstance(store, BackgroundArchive):
            raise CommandRefused(f"no sensor of the {name} finger was seen yet: {finger.health.reason}")
        self._check_calibration_is_over()
        async with self._calibrating:
            self._check_idle()
            try:
                await asyncio.to_thread(store.go_back, finger.serial, number)
            except InputError as error:
                raise CommandRefused(str(error)) from None
            finger.renew_pipeline()
            await self._until_seen_anew()
        return f"{name} ({finger.serial}): no-contact image {number} is in use again"

    def _check_idle(self) -> None:
        service = self._service
        if service.phase is not Phase.IDLE:
            raise CommandRefused(f"cannot calibrate while {service.phase}; release first")
        gripper = service.gripper.newest
        if gripper is not None and (gripper.holding or gripper.moving or gripper.closed_on_nothing):
            raise CommandRefused("cannot calibrate: the gripper moves, holds or is closed; open the jaws first")
        missing = [name for name, finger in service.fingers.items() if not finger.health.ready]
        if missing:
            raise CommandRefused(f"cannot calibrate: no frames from {' and '.join(missing)}; check the sensors")

    def _check_calibration_is_over(self) -> None:
        if self._calibrating.locked():
            raise CommandRefused("a calibration is under way; ask again in a second")

    async def _calibrated(self, finger: Finger) -> bool:
        """Whether there is a no-contact image; reading it would keep the loop waiting, so that is done beside it.

        Raises InputError where it is damaged.
        """
        if finger.serial is None:
            return False
        return await asyncio.to_thread(self._service.store.load_background, finger.serial) is not None

    async def _knows_contact(self, finger: Finger) -> bool:
        """Whether its word on contact counts: not without a good no-contact image, or no new one could be had."""
        try:
            return await self._calibrated(finger)
        except InputError:
            return False

    async def _take(self, new_gel: bool) -> dict[str, BackgroundImage]:
        """Both fingers at once; stored only if both are good and nothing has moved meanwhile. By finger."""
        fingers = self._service.fingers
        taps: dict[str, asyncio.Queue[Frame]] = {name: asyncio.Queue(maxsize=4) for name in fingers}
        try:
            for name, finger in fingers.items():
                finger.tap = taps[name]
            images = await asyncio.gather(*(collect(tap, name) for name, tap in taps.items()), return_exceptions=True)
        finally:
            for finger in fingers.values():
                finger.tap = None
        taken = {}
        for name, result in zip(fingers, images, strict=True):
            if isinstance(result, BaseException):
                raise result
            taken[name] = await asyncio.to_thread(average_background, result, name)
        self._check_idle()
        await self._store(taken, new_gel)
        await self._until_seen_anew()
        return taken

    async def _store(self, taken: Mapping[str, BackgroundImage], new_gel: bool) -> None:
        """All, and then all are used; raises CommandRefused that says which are stored, where a write fails.

        A finger whose image is stored uses it in any case: it is a good one, and a restart would.
        """
        fingers, store = self._service.fingers, self._service.store
        stored: list[str] = []
        name = ""
        try:
            for name, finger in fingers.items():
                if finger.serial is not None:
                    if isinstance(store, BackgroundArchive):
                        await asyncio.to_thread(store.save_background, finger.serial, taken[name], new_gel=new_gel)
                    else:
                        await asyncio.to_thread(store.save_background, finger.serial, taken[name])
                    stored.append(name)
        except (SlipguardError, OSError) as error:
            others = f"the new one of {' and '.join(stored)} is stored and in use" if stored else "nothing was stored"
            raise CommandRefused(
                f"the no-contact image of {name} could not be stored ({error}); {others}; calibrate again"
            ) from None
        finally:
            for one in stored:
                fingers[one].renew_pipeline()

    async def _until_seen_anew(self) -> None:
        """The first answers with the new images are there."""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                for finger in self._service.fingers.values():
                    await finger.answered.wait()
        except TimeoutError:
            raise CommandRefused("the no-contact images are stored, but no frames come any more") from None

    async def _ask(self, request: ControlRequest) -> str:
        return await self._service.request(request)
