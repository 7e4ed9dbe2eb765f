"""What people and programs may do with the running service: one method a command, and one snapshot of everything."""

from __future__ import annotations

import asyncio

from slipguard.daemon.calibration import TIMEOUT_S, NoContact, collect, no_contact_of
from slipguard.daemon.api import Control
from slipguard.daemon.service import Service
from slipguard.daemon.snapshot import snapshot, trouble
from slipguard.errors import CommandRefused
from slipguard.grasp.messages import Request, RequestKind
from slipguard.grasp.state import Phase


class Controls(Control):
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

    async def grasp(self, force_n: float | None = None) -> str:
        """Close on what is between the jaws. Needs all devices and both no-contact images."""
        waiting = self._service.waiting_for
        if waiting:
            raise CommandRefused(f"cannot grasp: not ready: {'; '.join(waiting)}")
        for name, finger in self._service.fingers.items():
            if finger.serial is None or self._service.store.load_no_contact(finger.serial) is None:
                raise CommandRefused(
                    f"cannot grasp: {name} finger ({finger.serial}) has no no-contact image; run `slipguard calibrate`"
                )
        return await self._ask(Request(RequestKind.GRASP, force_n=force_n))

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        """Lift what is held."""
        return await self._ask(Request(RequestKind.LIFT, height_mm=height_mm, speed_mm_s=speed_mm_s))

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        """Lower it again; by what it was lifted where no height is given."""
        return await self._ask(Request(RequestKind.LOWER, height_mm=height_mm, speed_mm_s=speed_mm_s))

    async def guard(self, on: bool) -> str:
        """Act on slip, or only watch."""
        return await self._ask(Request(RequestKind.GUARD_ON if on else RequestKind.GUARD_OFF))

    async def gripper(self, width_mm: float | None, force_n: float | None) -> str:
        """Move the jaws for another program; never opens a held object and never lowers its grip."""
        return await self._ask(Request(RequestKind.GRIPPER, width_mm=width_mm, force_n=force_n))

    async def release(self, width_mm: float | None = None) -> str:
        """Open the jaws, in every state."""
        return await self._ask(Request(RequestKind.RELEASE, width_mm=width_mm))

    async def clear(self) -> str:
        """Leave a fault whose cause is gone."""
        return await self._ask(Request(RequestKind.CLEAR))

    async def calibrate(self, *, force: bool = False) -> dict[str, NoContact]:
        """Take and store both fingers' no-contact images, by serial. Refused while anything is or may be touched.

        force: also where a stored image says that there is contact (its light may have changed).
        """
        service = self._service
        if self._calibrating.locked():
            raise CommandRefused("a calibration is under way")
        async with self._calibrating:
            if service.phase is not Phase.IDLE:
                raise CommandRefused(f"cannot calibrate while {service.phase}; release first")
            gripper = service.gripper.newest
            if gripper is not None and (gripper.holding or gripper.moving):
                raise CommandRefused("cannot calibrate: the gripper moves or holds something; open the jaws first")
            missing = [name for name, finger in service.fingers.items() if not finger.health.ready]
            if missing:
                raise CommandRefused(f"cannot calibrate: no frames from {' and '.join(missing)}; check the sensors")
            for name, finger in service.fingers.items():
                newest = finger.newest
                known = finger.serial is not None and service.store.load_no_contact(finger.serial) is not None
                if known and newest is not None and newest.estimate.contact and not force:
                    raise CommandRefused(
                        f"cannot calibrate: {name} finger is in contact; take the object away, or use --force "
                        "if the light has changed"
                    )
            return await self._take()

    async def _take(self) -> dict[str, NoContact]:
        taken = {}
        fingers = self._service.fingers
        try:
            for finger in fingers.values():
                finger.tap = asyncio.Queue(maxsize=4)
            async with asyncio.TaskGroup() as group:
                collecting = {
                    name: group.create_task(collect(finger.tap, name))
                    for name, finger in fingers.items()
                    if finger.tap is not None
                }
            for name, task in collecting.items():
                taken[name] = no_contact_of(task.result(), name)
        except* CommandRefused as refusals:
            raise refusals.exceptions[0] from None
        finally:
            for finger in fingers.values():
                finger.tap = None
        for name, image in taken.items():
            finger = fingers[name]
            if finger.serial is not None:
                self._service.store.save_no_contact(finger.serial, image)
                finger.renew_pipeline()
        await self._until_seen_anew()
        return taken

    async def _until_seen_anew(self) -> None:
        """The first answers with the new images are there."""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                while any(finger.newest is None for finger in self._service.fingers.values()):
                    await asyncio.sleep(0.005)
        except TimeoutError:
            raise CommandRefused("the no-contact images are stored, but no frames come any more") from None

    async def _ask(self, request: Request) -> str:
        return await self._service.request(request)
