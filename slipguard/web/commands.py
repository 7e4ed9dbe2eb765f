"""The commands: bodies are checked to the last key before anything is asked of the daemon."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeVar

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from slipguard.config_errors import first_complaint
from slipguard.errors import CommandRefused
from slipguard.web import models as b
from slipguard.web.disconnect import is_disconnected
from slipguard.web.errors import error, error_responses, with_error_response
from slipguard.web.route_context import RouteContext

BODY_MAX_BYTES = 4096
"""No request of this API needs more."""
BODY_S = 5.0
"""A body that takes longer to come is not waited for."""
B = TypeVar("B", bound=b.Body)
Act = Callable[[B], Awaitable[Mapping[str, object]]]


def add_commands(app: FastAPI, room: RouteContext) -> None:
    """One POST route for each command."""
    control = room.control

    async def calibrate(body: b.Calibrate) -> Mapping[str, object]:
        return await control.calibrate(body.force, body.new_gel)

    def add(
        path: str, kind: type[B], act: Act[B], about: str, answer: type[b.MessageResponse] = b.MessageResponse
    ) -> None:
        _add(app, room, path, kind, act, about, answer)

    add("/grasp", b.Grasp, lambda body: _said(control.grasp(body.force_n)), "Close on what is between the jaws.")
    add(
        "/lift",
        b.Move,
        lambda body: _said(control.lift(body.height_mm, body.speed_mm_s)),
        "Lift what is held; the answer comes when the lift has begun.",
    )
    add(
        "/lower",
        b.Move,
        lambda body: _said(control.lower(body.height_mm, body.speed_mm_s)),
        "Lower what is held, by as much as it was lifted where no height is given.",
    )
    add("/guard", b.GuardSwitch, lambda body: _said(control.guard(body.on)), "Act on slip, or only watch.")
    add(
        "/gripper",
        b.Jaws,
        lambda body: _said(control.gripper(body.width_mm, body.force_n)),
        "Move the jaws for another program; never opens a held object, never lowers its grip.",
    )
    add(
        "/release",
        b.Release,
        lambda body: _said(control.release(body.width_mm)),
        "Open the jaws, in every state: what is held drops.",
    )
    add("/clear", b.Nothing, lambda body: _said(control.clear()), "Leave a fault whose cause is gone.")
    add(
        "/no-contact",
        b.GoBack,
        lambda body: _said(control.go_back(body.finger, body.number)),
        "Put an older no-contact image of a finger's sensor to use again.",
    )
    add("/calibrate", b.Calibrate, calibrate, "Take and store both fingers' no-contact images.", b.CalibrationResponse)


def _add(
    app: FastAPI, room: RouteContext, path: str, kind: type[B], act: Act[B], about: str, answer: type[b.MessageResponse]
) -> None:
    async def endpoint(request: Request) -> Response:
        async def do() -> Response:
            raw = await _read(request)
            try:
                body = kind.model_validate_json(raw or b"{}")
            except ValidationError as wrong:
                broken = wrong.errors(include_url=False)[0]["type"] == "json_invalid"
                return error(400, "the body is not JSON") if broken else error(422, first_complaint(wrong, kind))
            if is_disconnected(request.scope):
                raise CommandRefused(f"{path} was given up by whoever asked for it, and is not done")
            try:
                return JSONResponse(dict(await act(body)))
            finally:
                room.forget()

        return await with_error_response(path, do())

    needed = any(field.is_required() for field in kind.model_fields.values())
    app.post(
        path,
        name=path[1:],
        description=about,
        response_model=answer,
        responses=error_responses(400, 401, 408, 409, 413, 422),
        openapi_extra={"requestBody": _described(kind, needed), "security": SECURITY},
    )(endpoint)


SECURITY: list[dict[str, list[str]]] = [{"token": []}, {"cookie": [], "session": []}]
"""On TCP; the Unix socket asks for neither."""


def _described(kind: type[b.Body], needed: bool) -> dict[str, Any]:
    return {"required": needed, "content": {"application/json": {"schema": kind.model_json_schema()}}}


async def _read(request: Request) -> bytes:
    """The body, as long as it is neither too large nor too slow."""
    body = b""
    try:
        async with asyncio.timeout(BODY_S):
            async for piece in request.stream():
                body += piece
                if len(body) > BODY_MAX_BYTES:
                    raise HTTPException(413, f"the body is larger than {BODY_MAX_BYTES} bytes")
    except TimeoutError:
        raise HTTPException(408, f"the body did not come within {BODY_S:g} s") from None
    return body


async def _said(answer: Awaitable[str]) -> dict[str, object]:
    return {"said": await answer}
