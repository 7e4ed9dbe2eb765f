"""After a restart a pipeline continues with its stored reference, or finds that it does not match."""

from __future__ import annotations

import numpy as np
import pytest
from blue_contact import BACKGROUND, ReadsBlue, frame
from drawn_masks import drawn

from slipguard.errors import FrameCorrupt
from slipguard.perception.declined import DeclineReason
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stored_reference import (
    DIFFERS_AFTER,
    MATCHES_AFTER,
    ResumingPipeline,
    StoredReference,
)


def pipeline() -> ResumingPipeline:
    return ResumingPipeline(Pipeline(ReadsBlue(), PerceptionSettings(), BACKGROUND, (1.0, 1.0, 1.0), 18.5))


def run(pipe: ResumingPipeline, shape: str, angles: list[float], start: int = 0) -> list[Estimate]:
    return [pipe.process(frame(drawn(shape, a, ragged_px=0.2, seed=k), k)) for k, a in enumerate(angles, start)]


def before(shape: str, rotation_deg: float) -> StoredReference:
    """What a pipeline that is gone now has left behind."""
    pipe = pipeline()
    steps = list(np.linspace(0.0, rotation_deg, 12))
    last = run(pipe, shape, [0.0] * 6 + steps)[-1]
    assert pipe.reference_image is not None
    assert last.rotation_deg is not None
    return StoredReference(pipe.reference_image, last.rotation_deg)


@pytest.mark.parametrize("rotation_deg", [0.0, 14.0, -38.0, 70.0])
def test_the_rotation_continues_from_the_stored_reference(rotation_deg: float) -> None:
    pipe = pipeline()
    known = before("key", rotation_deg)
    pipe.resume(known, 10.0)
    assert pipe.stored_reference_state == "waiting"
    assert pipe.reference_image is None
    estimates = run(pipe, "key", [rotation_deg + 3.0] * 6, start=600)
    assert [last_estimate.declined for last_estimate in estimates[: MATCHES_AFTER - 1]] == [
        DeclineReason.CHECKING_STORED_REFERENCE
    ] * (MATCHES_AFTER - 1)
    assert pipe.stored_reference_state == "matches"
    assert estimates[-1].rotation_deg == pytest.approx(rotation_deg + 3.0, abs=1.0)
    assert pipe.reference_image is known.image
    on = run(pipe, "key", list(np.linspace(rotation_deg + 3.0, rotation_deg + 15.0, 6)), start=606)[-1]
    assert on.rotation_deg == pytest.approx(rotation_deg + 15.0, abs=1.0)


def test_another_object_gets_a_new_reference_and_continues_from_the_last_rotation() -> None:
    pipe = pipeline()
    pipe.resume(before("key", 14.0), 10.0)
    estimates = run(pipe, "disc", [0.0] * DIFFERS_AFTER, start=600)
    assert {last_estimate.declined for last_estimate in estimates[:-1]} == {DeclineReason.CHECKING_STORED_REFERENCE}
    assert estimates[-1].rotation_deg is None
    assert pipe.stored_reference_state == "differs"
    run(pipe, "bar", [40.0] * 6, start=600 + DIFFERS_AFTER)
    rotated = run(pipe, "bar", list(np.linspace(40.0, 47.0, 6)), start=620)[-1]
    assert rotated.rotation_deg == pytest.approx(14.0 + 7.0, abs=1.0)
    assert pipe.earlier_rotation_deg == pytest.approx(14.0, abs=1.0)
    assert pipe.reference_image is not None


def test_the_rotation_before_the_stored_reference_is_added() -> None:
    known = before("key", 14.0)
    pipe = pipeline()
    pipe.resume(StoredReference(known.image, known.rotation_deg, 5.0), 10.0)
    estimates = run(pipe, "key", [16.0] * 6, start=600)
    assert estimates[-1].rotation_deg == pytest.approx(5.0 + 16.0, abs=1.0)
    assert pipe.earlier_rotation_deg == 5.0
    pipe.resume(StoredReference(known.image, known.rotation_deg, 5.0), 10.0)
    run(pipe, "disc", [0.0] * DIFFERS_AFTER, start=700)
    assert pipe.earlier_rotation_deg == pytest.approx(5.0 + 14.0, abs=1.0)


def test_a_reset_reference_starts_at_zero() -> None:
    pipe = pipeline()
    pipe.resume(before("key", 14.0), 10.0)
    pipe.reset_reference()
    assert pipe.stored_reference_state is None
    last = run(pipe, "key", [30.0] * 8, start=600)[-1]
    assert last.rotation_deg == pytest.approx(0.0, abs=0.5)


def test_without_contact_nothing_is_decided() -> None:
    pipe = pipeline()
    pipe.resume(before("key", 14.0), 10.0)
    for k in range(2 * DIFFERS_AFTER):
        assert pipe.process(frame(None, 600 + k)).declined == "no contact"
    assert pipe.stored_reference_state == "waiting"


def test_a_stored_image_without_contact_does_not_match() -> None:
    pipe = pipeline()
    pipe.resume(StoredReference(frame(None, 1).image, 14.0), 10.0)
    assert pipe.stored_reference_state == "differs"
    last = run(pipe, "key", [30.0] * 8, start=600)[-1]
    assert last.rotation_deg == pytest.approx(14.0, abs=0.5)


def test_a_stored_image_that_is_no_gel_image_is_rejected() -> None:
    with pytest.raises(FrameCorrupt):
        pipeline().resume(StoredReference(np.zeros((10, 10, 3), np.uint8), 0.0), 10.0)
