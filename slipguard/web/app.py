"""The local API over HTTP: reads the daemon's state and passes requests to it. It makes no decisions.

Bodies and responses are JSON objects, described at /openapi.json. Errors are {"error": one line}; their statuses are in
`slipguard.web.errors.STATUS_DESCRIPTIONS`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import FastAPI, Path, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException

from slipguard import __version__
from slipguard.daemon.api import state as models
from slipguard.devices import FINGERS
from slipguard.web.access import CONTROL_KEY, COOKIE, SESSION_HEADER
from slipguard.web.commands import add_commands
from slipguard.web.errors import EXCEPTION_HANDLERS, error_response, error_responses
from slipguard.web.images import EncodedImage
from slipguard.web.metrics import prometheus_text
from slipguard.web.page_routes import add_page
from slipguard.web.route_context import RouteContext

DESCRIPTION = """Keeps a robot from dropping what it holds. On the Unix socket, file permissions control access.
On TCP every command needs the token in the daemon's runtime directory, or the page's cookie and session key."""
TEXT_RESPONSE: dict[int | str, dict[str, Any]] = {
    200: {"description": "Prometheus text.", "content": {"text/plain": {"schema": {"type": "string"}}}}
}
FingerName = Annotated[str, Path(json_schema_extra={"enum": list(FINGERS)})]


def make_app(context: RouteContext) -> FastAPI:
    """Return the API of one daemon. Access control is separate: `slipguard.web.access.AccessMiddleware`."""
    app = FastAPI(
        title="slipguard",
        version=__version__,
        description=DESCRIPTION,
        telemetry={"tracing": False, "metrics": False, "logs": False, "auto_configure": False},
        docs_url=None,
        redoc_url=None,
        exception_handlers=EXCEPTION_HANDLERS,
    )
    _add_state(app, context)
    _add_images(app, context)
    _add_streams(app, context)
    add_page(app, context)
    add_commands(app, context)
    make_document = app.openapi

    def document_with_security() -> dict[str, Any]:
        document = make_document()
        document.setdefault("components", {})["securitySchemes"] = {
            "token": {"type": "http", "scheme": "bearer"},
            "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            "session": {"type": "apiKey", "in": "header", "name": SESSION_HEADER},
        }
        return document

    app.openapi = document_with_security  # type: ignore[method-assign]
    return app


def _add_state(app: FastAPI, context: RouteContext) -> None:
    @app.get("/state", response_model=models.State, responses=error_responses())
    async def state() -> Response:
        """Return the complete state, at most a tenth of a second old."""
        return Response(await context.state.get(), media_type="application/json")

    @app.get("/healthz", response_model=models.HealthyResponse, responses=error_responses())
    async def healthz() -> Response:
        """Return whether the daemon is healthy; 503 with the reason if it is not."""
        problem = await context.health_problem.get()
        return JSONResponse({"status": "ok"}) if problem is None else error_response(503, problem)

    @app.get("/metrics", response_class=Response, responses=TEXT_RESPONSE | error_responses())
    async def metrics() -> Response:
        """Return state and counters in the format of Prometheus."""
        text = prometheus_text(await context.state.get(), await context.counters.get())
        return Response(text, media_type=CONTENT_TYPE_LATEST)

    @app.get("/background", response_model=dict[str, models.StoredBackgrounds], responses=error_responses())
    async def backgrounds() -> Response:
        """Return number, time, noise and brightness of all stored background images, by finger."""
        return Response(await context.backgrounds.get(), media_type="application/json")

    @app.get("/access", response_model=models.AccessInfo, responses=error_responses())
    async def access(request: Request) -> Response:
        """Return whether this client may send commands."""
        return JSONResponse({"control": bool(request.scope.get(CONTROL_KEY, True))})


def _add_images(app: FastAPI, context: RouteContext) -> None:
    def responses(media_type: str, description: str) -> dict[int | str, dict[str, Any]]:
        content = {media_type: {"schema": {"type": "string", "format": "binary"}}}
        return {200: {"description": description, "content": content}} | error_responses(404, 409, 422)

    @app.get("/frame/{finger}", response_class=Response, responses=responses("image/png", "The unmodified frame."))
    async def frame(finger: FingerName) -> Response:
        """Return the newest frame as it was captured; serial number, frame number and capture time are in headers."""
        return _image_response(await context.images.raw(_known(finger)), "image/png")

    @app.get("/background/{finger}", response_class=Response, responses=responses("image/png", "The mean image."))
    async def background(
        finger: FingerName, number: Annotated[int | None, Query(ge=1, le=1_000_000)] = None
    ) -> Response:
        """Return a stored background image, by default the newest; its number is in the header x-sequence."""
        return _image_response(await context.images.background(_known(finger), number), "image/png")

    @app.get("/image/{finger}", response_class=Response, responses=responses("image/jpeg", "For display."))
    async def overlay_image(finger: FingerName, overlay: Annotated[Literal["0", "1"], Query()] = "1") -> Response:
        """Return the newest processed frame, with contour, skeleton and axis of the contact drawn over it."""
        return _image_response(await context.images.with_overlay(_known(finger), overlay == "1"), "image/jpeg")


def _add_streams(app: FastAPI, context: RouteContext) -> None:
    @app.websocket("/live")
    async def live(socket: WebSocket) -> None:
        """Send `history`, then `state` ten times per second, and each `event` at once."""
        await context.live.serve(socket)

    @app.websocket("/estimates")
    async def estimates(socket: WebSocket) -> None:
        """Send each new estimate, as soon as the control loop has used it."""
        await context.estimates.serve(socket)

    @app.websocket("/frames/{finger}")
    async def frames(socket: WebSocket, finger: str) -> None:
        """Send each new frame of a finger, as it was captured."""
        if finger in context.frames:
            await context.frames[finger].serve(socket)
        else:
            await socket.send_denial_response(error_response(404, _no_finger(finger)))


def _image_response(image: EncodedImage, media_type: str) -> Response:
    headers = {
        "x-serial": image.serial,
        "x-sequence": str(image.sequence),
        "x-captured-at-s": f"{image.captured_at_s:.6f}",
    }
    return Response(image.content, media_type=media_type, headers=headers)


def _known(finger: str) -> str:
    if finger not in FINGERS:
        raise HTTPException(404, _no_finger(finger))
    return finger


def _no_finger(name: str) -> str:
    return f"no finger {name!r}; choose from: {', '.join(FINGERS)}"
