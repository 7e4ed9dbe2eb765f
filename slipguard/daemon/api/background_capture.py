"""Takes, stores, lists and restores the background images of both fingers while the daemon runs."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import CalibrateRequest, RestoreBackgroundRequest
from slipguard.daemon.api.state import StoredBackgrounds
from slipguard.daemon.loop.finger import Finger
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.background_images import (
    TIMEOUT_S,
    BackgroundImage,
    BackgroundVersion,
    average_background,
    collect_images,
)
from slipguard.errors import CommandRefused, InputError, SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.thread_priority import set_worker_priority


def _contact(finger: str, estimate: Estimate) -> str | None:
    """Return that a finger is in contact, or cannot see whether it is; None if it sees no contact."""
    if estimate.unusable:
        return f"{finger} finger cannot see whether it is in contact ({estimate.declined})"
    return f"{finger} finger is in contact" if estimate.contact else None


class BackgroundCapture:
    """One calibration at a time; refused while an object is or may be touched. Methods raise CommandRefused."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._lock = asyncio.Lock()
        # A thread of its own, so that reading stored images delays neither frames nor the gripper.
        self._disk_thread = ThreadPoolExecutor(1, "slipguard-images", initializer=set_worker_priority)

    def check_not_running(self) -> None:
        """Raise CommandRefused while a calibration is running."""
        if self._lock.locked():
            raise CommandRefused("a calibration is running; try again in a second")

    async def check_calibrated(self) -> None:
        """Raise CommandRefused if a finger has no background image, or a damaged one."""
        for name, finger in self._service.fingers.items():
            try:
                calibrated = await self._has_background(finger)
            except InputError as error:
                raise CommandRefused(f"cannot grasp: {error}") from None
            if not calibrated:
                raise CommandRefused(
                    f"cannot grasp: {name} finger ({finger.serial}) has no background image; run `slipguard calibrate`"
                )

    async def calibrate(self, request: CalibrateRequest) -> dict[str, BackgroundImage]:
        """Take and store the background images of both fingers; return them by finger."""
        self.check_not_running()
        async with self._lock:
            self._check_idle()
            if not request.force and (touched := await self.finger_in_contact()) is not None:
                raise CommandRefused(
                    f"cannot calibrate: {touched}; remove the object, or use --force if the light has changed"
                )
            taken = await self._take()
            self._check_idle()
            await self._store(taken, request.new_gel)
            await self._wait_for_estimates()
            return taken

    async def finger_in_contact(self) -> str | None:
        """Return which finger is in contact, or cannot see whether it is; None if neither."""
        for name, finger in self._service.fingers.items():
            newest = finger.newest
            if (
                newest is not None
                and (why := _contact(name, newest.estimate))
                and await self._contact_is_reliable(finger)
            ):
                return why
        return None

    async def may_hold_reason(self) -> str | None:
        """Return why something may be held; None if both fingers see no contact.

        Before its first background image a finger cannot detect contact: then only a stored grip counts.
        """
        adoption = self._service.state.adoption
        if adoption.outdated or adoption.remembered is not None:
            return "something was held before the last start, or may have been, and it is unknown whether it still is"
        for name, finger in self._service.fingers.items():
            if finger.serial is None:
                return f"no sensor was found yet for the {name} finger ({finger.health.reason})"
            try:
                if not await self._has_background(finger):
                    continue
            except InputError as error:
                return str(error)
            health, estimate = finger.observe(asyncio.get_running_loop().time())
            if estimate is None:
                return f"{name} finger has no recent estimate ({health.why or health.condition.value})"
            if (why := _contact(name, estimate)) is not None:
                return why
        return None

    async def versions(self) -> dict[str, StoredBackgrounds]:
        """Return the stored images of each finger's sensor."""
        return {
            name: StoredBackgrounds(
                serial=finger.serial,
                versions=[] if finger.serial is None else await self._stored_versions(finger.serial),
            )
            for name, finger in self._service.fingers.items()
        }

    async def find(self, finger: Finger, number: int | None) -> tuple[str, int, BackgroundImage]:
        """Return serial number, number and a stored background image. number: None for the newest.

        Raises CommandRefused if there is no such image, or if it is damaged.
        """
        serial = finger.serial
        if serial is None:
            raise CommandRefused(f"the sensor of the {finger.name} finger was not opened yet: {finger.health.reason}")
        stored = [version.number for version in await self._stored_versions(serial)]
        chosen = max(stored, default=None) if number is None else number
        found = None
        if chosen is not None:
            load = self._service.store.load_background
            try:
                found = await asyncio.get_running_loop().run_in_executor(self._disk_thread, load, serial, chosen)
            except InputError as error:
                raise CommandRefused(str(error)) from None
        if chosen is None or found is None:
            known = ", ".join(map(str, stored)) or "none"
            asked = "" if chosen is None else f" {chosen}"
            raise CommandRefused(f"{serial}: background image{asked} not found; stored numbers: {known}")
        return serial, chosen, found

    async def _stored_versions(self, serial: str) -> list[BackgroundVersion]:
        read = self._service.store.background_versions
        return await asyncio.get_running_loop().run_in_executor(self._disk_thread, read, serial)

    async def restore(self, request: RestoreBackgroundRequest) -> str:
        """Use an older background image again; return a message."""
        name, number = request.finger, request.number
        finger, store = self._service.fingers[name], self._service.store
        if finger.serial is None:
            raise CommandRefused(f"{name} finger: no sensor was found yet: {finger.health.reason}")
        self.check_not_running()
        async with self._lock:
            self._check_idle()
            try:
                await asyncio.to_thread(store.restore_background, finger.serial, number)
            except InputError as error:
                raise CommandRefused(str(error)) from None
            finger.renew_pipeline()
            await self._wait_for_estimates()
        return f"{name} ({finger.serial}): background image {number} is in use again"

    def _check_idle(self) -> None:
        service = self._service
        if service.phase is not Phase.IDLE:
            raise CommandRefused(f"cannot calibrate while {service.phase}; support the object, then release it")
        gripper = service.gripper.newest
        if gripper is not None and (gripper.holding or gripper.moving or gripper.closed_on_nothing):
            raise CommandRefused(
                "cannot calibrate: the gripper is moving, holding or closed; support what it holds, then open the jaws"
            )
        now_s = asyncio.get_running_loop().time()
        missing = [name for name, finger in service.fingers.items() if not finger.delivers(now_s)]
        if missing:
            raise CommandRefused(f"cannot calibrate: no frames from {' and '.join(missing)}; check the sensors")

    async def _has_background(self, finger: Finger) -> bool:
        """Return whether a background image is stored. Raises InputError if it is damaged."""
        if finger.serial is None:
            return False
        # In a thread: reading the file would block the loop.
        return await asyncio.to_thread(self._service.store.load_background, finger.serial) is not None

    async def _contact_is_reliable(self, finger: Finger) -> bool:
        """Return whether the finger can detect contact: not without a good background image."""
        try:
            return await self._has_background(finger)
        except InputError:
            return False

    async def _take(self) -> dict[str, BackgroundImage]:
        """Take one background image per finger, at the same time."""
        fingers = self._service.fingers
        with contextlib.ExitStack() as copying:
            copies = {name: copying.enter_context(finger.capture.copy_frames()) for name, finger in fingers.items()}
            collecting = (collect_images(frames, name) for name, frames in copies.items())
            images = await asyncio.gather(*collecting, return_exceptions=True)
        taken = {}
        for name, result in zip(fingers, images, strict=True):
            if isinstance(result, BaseException):
                raise result
            taken[name] = await asyncio.to_thread(average_background, result, name)
        return taken

    async def _store(self, taken: Mapping[str, BackgroundImage], new_gel: bool) -> None:
        """Store all images. If a write fails, the error says which images are stored.

        A finger whose image is stored uses it at once: the image is good, and a restart would use it too.
        """
        fingers, store = self._service.fingers, self._service.store
        stored: list[str] = []
        name = ""
        try:
            for name, finger in fingers.items():
                if finger.serial is not None:
                    await asyncio.to_thread(store.save_background, finger.serial, taken[name], new_gel=new_gel)
                    stored.append(name)
        except (SlipguardError, OSError) as error:
            others = f"the new image of {' and '.join(stored)} is in use" if stored else "nothing was stored"
            raise CommandRefused(
                f"the background image of {name} could not be stored ({error}); {others}; calibrate again"
            ) from None
        finally:
            for one in stored:
                fingers[one].renew_pipeline()

    async def _wait_for_estimates(self) -> None:
        """Wait for the first estimates with the new images."""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                for finger in self._service.fingers.values():
                    await finger.has_estimate.wait()
        except TimeoutError:
            raise CommandRefused(
                f"the background images are stored, but no frame arrived within {TIMEOUT_S:g} s; check the sensors"
            ) from None
