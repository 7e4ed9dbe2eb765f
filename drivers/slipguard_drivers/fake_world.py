"""What the fakes need of the simulated world that they share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slipguard.errors import ConfigError

if TYPE_CHECKING:
    from slipguard.devices import DriverContext
    from slipguard.sim.world import World


def require_world(context: DriverContext) -> World:
    """Return the world the fakes share. Raises ConfigError where there is none."""
    if context.world is None:
        raise ConfigError(
            f"{context.name}: driver 'fake' needs the simulated world, and none was made; "
            "start with --sim, or name a real driver"
        )
    world: World = context.world  # type: ignore[assignment, unused-ignore]
    return world
