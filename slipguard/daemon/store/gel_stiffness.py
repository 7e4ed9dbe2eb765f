"""The learned stiffness of the gels, kept by serial number, so that a start does not forget it.

Both gels twist with the one object between them, so only their mean is measured, and stored for each of the two. Two
sensors that were not used together before are expected to have the mean of both. A gel that was replaced, as
`slipguard calibrate --new-gel` records, is unknown again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import structlog

from slipguard.control.load_state import STIFFNESS_PRIOR, LogNormal
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.daemon.store.state_dir import StateDir
from slipguard.errors import InputError, SlipguardError

log = structlog.get_logger()


def restore_stiffness(
    state_dir: StateDir, serials: Sequence[str], warning: Callable[[str], object] = log.warning
) -> LogNormal:
    """Return the stiffness of these sensors' gels; what is expected of any gel if one of them is unknown.

    Args:
        state_dir: Where it is stored.
        serials: Of both sensors; an empty one is not known before the sensor is opened.
        warning: Receives one line if a file is damaged.
    """
    try:
        known = [state_dir.load_stiffness(serial) for serial in serials if serial]
    except SlipguardError as error:
        warning(f"the learned stiffness of the gels is not used: {error}")
        return STIFFNESS_PRIOR
    gels = [gel for gel in known if gel is not None]
    if len(gels) < len(serials):
        return STIFFNESS_PRIOR
    return LogNormal(sum(gel.median for gel in gels) / len(gels), max(gel.spread for gel in gels))


class StiffnessSaver:
    """Observes decisions and saves the stiffness in a thread, after each grasp that has shown it.

    Args:
        state_dir: Where it is stored.
        serials: Of both sensors; an empty one is not stored.
        known: The stiffness at the start.
        info: Receives the recovery of the disk.
        warning: Receives failures of the disk.
    """

    def __init__(
        self,
        state_dir: StateDir,
        serials: Sequence[str],
        known: LogNormal,
        info: Callable[[str], None],
        warning: Callable[[str], None],
    ) -> None:
        self._state_dir, self._saved = state_dir, known
        self._gels: dict[str, int | None] = {}
        """A gel that is replaced while the daemon runs is not stored with what its predecessor has shown."""
        for serial in filter(None, serials):
            with contextlib.suppress(InputError):  # no name for a folder: logged with the background image
                self._gels[serial] = state_dir.gel_number(serial)
        self._disk = DiskWriter("gel stiffness", "the stiffness of the gels", info, warning)

    def add_decision(self, decision: Decision) -> None:
        """Save what has changed; to be called after every cycle of the loop."""
        stiffness = decision.state_before.grasp.gel
        if self._disk.busy or (stiffness == self._saved and not self._disk.due):
            return
        self._saved = stiffness
        self._disk.begin(lambda: self._save(stiffness))

    def _save(self, stiffness: LogNormal) -> None:
        for serial, number in self._gels.items():
            self._state_dir.save_stiffness(serial, stiffness, number)
