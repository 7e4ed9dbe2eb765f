"""The animation of README.md: its panels follow the record of a lift."""

from __future__ import annotations

from slipguard.sim.world import WorldTruth
from slipguard.sim_lifts.lift_record import LiftRecord
from tests.campaigns.readme_animation import BEFORE_S, LiftPanel


def truth(time_s: float, rotation_deg: float) -> WorldTruth:
    return WorldTruth(
        time_s=time_s, object_name="bar", rotation_deg=rotation_deg, elastic_deg=0.0, slip_deg=rotation_deg,
        rate_deg_s=0.0, angle_deg=90.0 + rotation_deg, slip_mm=0.0, slip_rate_mm_s=0.0, elastic_mm=0.0, force_n=40.0,
        applied_n=40.0, needed_force_n=60.0, load_n=5.0, height_mm=100.0 * time_s, on_table=False, in_contact=True,
        slipping=rotation_deg > 0.0, dropped=None,
    )  # fmt: skip


def has_red_text(panel: LiftPanel, after_s: float) -> bool:
    text = panel.draw(after_s)[190:, :140].astype(int)
    return bool((text[..., 2] - text[..., 0] > 60).any())


def test_a_drop_is_drawn_when_the_lift_ends_with_one() -> None:
    record = LiftRecord("bar", truth=[truth(0.1 * step, 6.0 * step) for step in range(11)], ended_at_s=1.0)
    record.outcome = "dropped"
    panel = LiftPanel(record, guarded=False)
    drop_s = 0.9 + BEFORE_S
    assert not has_red_text(panel, drop_s - 0.2)
    assert has_red_text(panel, drop_s + 0.1)
    assert (panel.draw(drop_s + 0.1) != panel.draw(drop_s + 0.2)).any(), "it falls"
    record.outcome = "held"
    assert not has_red_text(LiftPanel(record, guarded=True), drop_s + 0.1)
