"""The local API: HTTP over a Unix socket. It answers from snapshots and hands wishes on; it decides nothing itself.

    GET  /state /healthz /frame/left /frame/right
    POST /grasp /lift /lower /guard /gripper /release /clear /calibrate

Bodies and answers are JSON objects; a frame is a PNG, with its sensor, number and time in the headers. Whatever cannot
be done is answered with {"error": one line}: 400 no JSON, 409 refused, 413 too large, 422 not what is allowed, 503 a
device or the daemon is not well.
"""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from typing import Annotated, Any, Protocol, TypeVar

import cv2
import numpy as np
import structlog
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from slipguard.complaints import first_complaint
from slipguard.daemon.calibration import NoContact
from slipguard.daemon.serve import serve
from slipguard.devices import Frame
from slipguard.errors import CommandRefused, SlipguardError

BODY_MAX_BYTES = 4096
"""No request of this API needs more."""

__all__ = ["Control", "make_app", "serve"]

log = structlog.get_logger()


class Control(Protocol):
    """What the API needs of the daemon. Commands answer with one line and raise CommandRefused with the reason."""

    @abstractmethod
    def snapshot(self) -> Mapping[str, object]:
        """Everything there is to know now, as JSON can say it; does not wait."""

    @abstractmethod
    def trouble(self) -> str | None:
        """Why the daemon is not well, in one line; None if it is."""

    @abstractmethod
    def frame(self, finger: str) -> tuple[str, Frame]:
        """Serial number and newest frame of a finger; raises CommandRefused where there is none."""

    @abstractmethod
    async def grasp(self, force_n: float | None = None) -> str: ...

    @abstractmethod
    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str: ...

    @abstractmethod
    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str: ...

    @abstractmethod
    async def guard(self, on: bool) -> str: ...

    @abstractmethod
    async def gripper(self, width_mm: float | None, force_n: float | None) -> str: ...

    @abstractmethod
    async def release(self, width_mm: float | None = None) -> str: ...

    @abstractmethod
    async def clear(self) -> str: ...

    @abstractmethod
    async def calibrate(self, *, force: bool = False) -> Mapping[str, NoContact]:
        """The images taken, by finger."""


Force = Annotated[float, Field(gt=0.0, le=235.0)]
Height = Annotated[float, Field(gt=0.0, le=2000.0)]
Speed = Annotated[float, Field(gt=0.0, le=250.0)]
Width = Annotated[float, Field(ge=0.0, le=200.0)]


class Body(BaseModel):
    """Base of all bodies: no unknown keys, no infinities, no numbers in quotes."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Nothing(Body):
    """An empty object, or no body at all."""


class Grasp(Body):
    """force_n: per finger; None: from the configuration."""

    force_n: Force | None = None


class Move(Body):
    """Of the arm; None: from the configuration."""

    height_mm: Height | None = None
    speed_mm_s: Speed | None = None


class GuardSwitch(Body):
    """Act on slip, or only watch."""

    on: bool


class Jaws(Body):
    """Another program's grip."""

    width_mm: Width | None = None
    force_n: Force | None = None


class Release(Body):
    """Opening drops what is held, so it must be confirmed."""

    confirm: bool
    width_mm: Width | None = None

    @field_validator("confirm")
    @classmethod
    def _confirmed(cls, confirm: bool) -> bool:
        if not confirm:
            raise ValueError("must be true: opening drops what is held")
        return confirm


class Calibrate(Body):
    """force: also where a stored image says that there is contact."""

    force: bool = False


B = TypeVar("B", bound=Body)


def calibration_answer(taken: Mapping[str, NoContact]) -> dict[str, object]:
    """What a calibration says of the images it took, by finger."""
    fingers = {
        name: {
            "frames": one.frames,
            "noise_bgr": [round(level, 2) for level in one.noise_bgr],
            "level_bgr": [round(float(level), 1) for level in one.image.mean(axis=(0, 1))],
        }
        for name, one in taken.items()
    }
    return {"said": f"no-contact images of {' and '.join(taken)} stored", "fingers": fingers}


def make_app(control: Control) -> Starlette:
    """The API of one daemon."""

    async def state(request: Request) -> Response:
        return JSONResponse(dict(control.snapshot()))

    async def healthz(request: Request) -> Response:
        why = control.trouble()
        return JSONResponse({"status": "ok"}) if why is None else _error(503, why)

    async def frame(request: Request) -> Response:
        try:
            serial, newest = control.frame(request.path_params["finger"])
        except CommandRefused as error:
            return _error(409, str(error))
        png = await asyncio.to_thread(_png, newest.image)
        told = {
            "x-serial": serial,
            "x-sequence": str(newest.sequence),
            "x-captured-at-s": f"{newest.captured_at_s:.6f}",
        }
        return Response(png, media_type="image/png", headers=told)

    async def calibrate(body: Calibrate) -> dict[str, object]:
        return calibration_answer(await control.calibrate(force=body.force))

    return Starlette(
        routes=[
            Route("/state", state, methods=["GET"]),
            Route("/healthz", healthz, methods=["GET"]),
            Route("/frame/{finger}", frame, methods=["GET"]),
            _command("/grasp", Grasp, lambda body: _said(control.grasp(body.force_n))),
            _command("/lift", Move, lambda body: _said(control.lift(body.height_mm, body.speed_mm_s))),
            _command("/lower", Move, lambda body: _said(control.lower(body.height_mm, body.speed_mm_s))),
            _command("/guard", GuardSwitch, lambda body: _said(control.guard(body.on))),
            _command("/gripper", Jaws, lambda body: _said(control.gripper(body.width_mm, body.force_n))),
            _command("/release", Release, lambda body: _said(control.release(body.width_mm))),
            _command("/clear", Nothing, lambda body: _said(control.clear())),
            _command("/calibrate", Calibrate, calibrate),
        ],
        exception_handlers={HTTPException: _http_error},
    )


def _command(path: str, kind: type[B], act: Callable[[B], Awaitable[Mapping[str, object]]]) -> Route:
    """A POST route: check the body, act, and put every failure into one line."""

    async def endpoint(request: Request) -> Response:
        try:
            raw = await _read(request)
            return JSONResponse(dict(await act(kind.model_validate_json(raw or b"{}"))))
        except ValidationError as error:
            broken = error.errors(include_url=False)[0]["type"] == "json_invalid"
            return _error(400, "the body is not JSON") if broken else _error(422, first_complaint(error, kind))
        except CommandRefused as error:
            return _error(409, str(error))
        except SlipguardError as error:
            return _error(503, str(error))
        except HTTPException:
            raise
        except Exception as error:
            log.exception("a request failed", path=path)
            return _error(500, f"{path} failed inside the daemon ({type(error).__name__}); its log says more")

    return Route(path, endpoint, methods=["POST"])


async def _read(request: Request) -> bytes:
    """The body, as long as it is not too large."""
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > BODY_MAX_BYTES:
            raise HTTPException(413, f"the body is larger than {BODY_MAX_BYTES} bytes")
    return body


async def _said(answer: Awaitable[str]) -> dict[str, object]:
    return {"said": await answer}


def _png(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _error(status: int, text: str) -> JSONResponse:
    return JSONResponse({"error": " ".join(text.split())}, status_code=status)


async def _http_error(request: Request, error: Exception) -> Response:
    """Starlette's own errors (no such path, wrong method) in the same form."""
    status: Any = getattr(error, "status_code", 500)
    detail = getattr(error, "detail", "")
    if status == 404:
        detail = f"no such path {request.url.path}; there are /state, /healthz, /frame/FINGER and one for each command"
    elif status == 405:
        detail = (
            f"{request.method} {request.url.path} is not possible; /state, /healthz and /frame take GET, commands POST"
        )
    return _error(status, str(detail))
