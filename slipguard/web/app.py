"""The local API: HTTP that answers from what the daemon knows and hands wishes on; it decides nothing itself.

Bodies and answers are JSON objects, described at /openapi.json. Whatever cannot be done is answered with
{"error": one line}: see `slipguard.web.errors.MEANS`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import FastAPI, Path, Query, Request, Response, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException

from slipguard import __version__
from slipguard.web import models as b
from slipguard.web.access import CONTROL_KEY, COOKIE, SESSION
from slipguard.web.commands import add_commands
from slipguard.web.errors import error, error_responses, http_error, with_error_response
from slipguard.web.images import FINGERS
from slipguard.web.metrics import exposition
from slipguard.web.page_routes import add_page
from slipguard.web.route_context import RouteContext

ABOUT = """Keeps a robot from dropping what it holds. On the Unix socket, file permissions decide who may ask.
On TCP every command needs the token in the daemon's runtime directory, or the page's cookie and second secret."""
TEXT: dict[int | str, dict[str, Any]] = {
    200: {"description": "Prometheus text.", "content": {"text/plain": {"schema": {"type": "string"}}}}
}
FingerName = Annotated[str, Path(json_schema_extra={"enum": list(FINGERS)})]


def make_app(room: RouteContext) -> FastAPI:
    """The API of one daemon. Whoever may reach it may command, unless `slipguard.web.access.Gate` stands before it."""
    app = FastAPI(
        title="slipguard",
        version=__version__,
        description=ABOUT,
        telemetry={"tracing": False, "metrics": False, "logs": False, "auto_configure": False},
        docs_url=None,
        redoc_url=None,
        exception_handlers={HTTPException: http_error, RequestValidationError: _bad_parameter},
    )
    _add_reads(app, room)
    _add_pictures(app, room)
    add_page(app, room)
    add_commands(app, room)
    make = app.openapi

    def described() -> dict[str, Any]:
        document = make()
        document.setdefault("components", {})["securitySchemes"] = {
            "token": {"type": "http", "scheme": "bearer"},
            "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            "session": {"type": "apiKey", "in": "header", "name": SESSION},
        }
        return document

    app.openapi = described  # type: ignore[method-assign]
    return app


def _add_reads(app: FastAPI, room: RouteContext) -> None:
    @app.get("/state", response_model=b.StateResponse, responses=error_responses())
    async def state() -> Response:
        """Everything the daemon knows now, at most a tenth of a second old."""

        async def look() -> Response:
            return Response(await room.state.get(), media_type="application/json")

        return await with_error_response("/state", look())

    @app.get("/healthz", response_model=b.HealthyResponse, responses=error_responses())
    async def healthz() -> Response:
        """Whether the daemon is well; 503 with the reason where it is not."""

        async def look() -> Response:
            why = await room.trouble.get()
            return JSONResponse({"status": "ok"}) if why is None else error(503, why)

        return await with_error_response("/healthz", look())

    @app.get("/metrics", response_class=Response, responses=TEXT | error_responses())
    async def metrics() -> Response:
        """State and tallies as Prometheus reads them."""

        async def look() -> Response:
            text = exposition(await room.state.get(), await room.tallies.get())
            return Response(text, media_type=CONTENT_TYPE_LATEST)

        return await with_error_response("/metrics", look())

    @app.get("/no-contact", response_model=dict[str, b.StoredBackgrounds], responses=error_responses())
    async def no_contacts() -> Response:
        """What is stored of each finger's sensor: number, time, noise and light of every no-contact image."""

        async def look() -> Response:
            return Response(await room.no_contacts.get(), media_type="application/json")

        return await with_error_response("/no-contact", look())

    @app.get("/access", response_model=b.AccessInfo, responses=error_responses())
    async def access(request: Request) -> Response:
        """Whether whoever asks may also command."""
        return JSONResponse({"control": bool(request.scope.get(CONTROL_KEY, True))})

    @app.websocket("/live")
    async def live(socket: WebSocket) -> None:
        """`history`, then ten times a second `state`, and every `event` at once."""
        await room.live.serve(socket)


def _add_pictures(app: FastAPI, room: RouteContext) -> None:
    def answers(kind: str, about: str) -> dict[int | str, dict[str, Any]]:
        picture = {"type": "string", "format": "binary"}
        return {200: {"description": about, "content": {kind: {"schema": picture}}}} | error_responses(404, 409, 422)

    @app.get("/frame/{finger}", response_class=Response, responses=answers("image/png", "As the sensor gave it."))
    async def frame(finger: FingerName) -> Response:
        """The newest frame as it came; serial number, number and capture time are in the headers."""
        return await _picture(room, "/frame", finger, "image/png")

    @app.get("/no-contact/{finger}", response_class=Response, responses=answers("image/png", "As it was averaged."))
    async def no_contact(
        finger: FingerName, number: Annotated[int | None, Query(ge=1, le=1_000_000)] = None
    ) -> Response:
        """A stored no-contact image, the newest if not told which; its number is in the header x-sequence."""

        async def look() -> Response:
            _check(finger)
            found = await room.pictures.stored(finger, number)
            told = {"x-serial": found.serial, "x-sequence": str(found.sequence), "x-captured-at-s": "0"}
            return Response(found.content, media_type="image/png", headers=told)

        return await with_error_response("/no-contact", look())

    @app.get("/picture/{finger}", response_class=Response, responses=answers("image/jpeg", "For people."))
    async def picture(finger: FingerName, overlay: Annotated[Literal["0", "1"], Query()] = "1") -> Response:
        """The newest judged frame, with outline, thinned line and axis of the contact drawn over it."""
        return await _picture(room, "/picture", finger, "image/jpeg", overlay == "1")


async def _picture(room: RouteContext, path: str, finger: str, kind: str, overlay: bool = False) -> Response:
    async def look() -> Response:
        _check(finger)
        found = await (room.pictures.raw(finger) if kind == "image/png" else room.pictures.drawn(finger, overlay))
        told = {
            "x-serial": found.serial,
            "x-sequence": str(found.sequence),
            "x-captured-at-s": f"{found.captured_at_s:.6f}",
        }
        return Response(found.content, media_type=kind, headers=told)

    return await with_error_response(path, look())


def _check(finger: str) -> None:
    if finger not in FINGERS:
        raise HTTPException(404, f"no finger {finger!r}; there are: {', '.join(FINGERS)}")


async def _bad_parameter(request: Request, raised: Exception) -> Response:
    """What is wrong with a parameter in the address, in one line."""
    problems = raised.errors() if isinstance(raised, RequestValidationError) else []
    problem = problems[0] if problems else {"loc": ("request",), "msg": "not what is allowed"}
    message = str(problem["msg"])
    return error(422, f"{problem['loc'][-1]}: {message[:1].lower()}{message[1:]}")
