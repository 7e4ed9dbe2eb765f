"""The POST routes: one for each request. The body is validated completely before the daemon is called."""

from __future__ import annotations

import asyncio

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from slipguard.config_errors import describe_validation_error
from slipguard.daemon.api.requests import REQUESTS, CalibrateRequest, DaemonRequest
from slipguard.daemon.api.state import CalibrationResponse, MessageResponse
from slipguard.errors import CommandRefused
from slipguard.web.connections import is_disconnected
from slipguard.web.errors import error_responses
from slipguard.web.route_context import RouteContext

BODY_MAX_BYTES = 4096
BODY_TIMEOUT_S = 5.0
SECURITY: list[dict[str, list[str]]] = [{"token": []}, {"cookie": [], "session": []}]
"""For TCP; the Unix socket needs neither."""


def add_commands(app: FastAPI, context: RouteContext) -> None:
    """Add `POST /<kind>` for each kind of request."""
    for kind, model in REQUESTS.items():
        _add_command(app, context, f"/{kind}", model)


def _add_command(app: FastAPI, context: RouteContext, path: str, model: type[DaemonRequest]) -> None:
    async def endpoint(http_request: Request) -> Response:
        raw = await _read_body(http_request)
        try:
            request = model.model_validate_json(raw or b"{}")
        except ValidationError as invalid:
            if invalid.errors(include_url=False)[0]["type"] == "json_invalid":
                raise HTTPException(400, "the body is not JSON") from None
            raise HTTPException(422, describe_validation_error(invalid, model)) from None
        if is_disconnected(http_request.scope):
            raise CommandRefused(f"{path}: the client closed the connection; the request was not executed")
        try:
            return JSONResponse(dict(await context.daemon.submit(request)))
        finally:
            context.invalidate()

    body_schema = {"application/json": {"schema": model.model_json_schema()}}
    body_required = any(field.is_required() for field in model.model_fields.values())
    app.post(
        path,
        name=path[1:],
        description=model.__doc__,
        response_model=CalibrationResponse if model is CalibrateRequest else MessageResponse,
        responses=error_responses(400, 401, 408, 409, 413, 422),
        openapi_extra={"requestBody": {"required": body_required, "content": body_schema}, "security": SECURITY},
    )(endpoint)


async def _read_body(request: Request) -> bytes:
    """Return the body. Raises HTTPException if it is too large or too slow."""
    body = b""
    try:
        async with asyncio.timeout(BODY_TIMEOUT_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > BODY_MAX_BYTES:
                    raise HTTPException(413, f"the body is larger than {BODY_MAX_BYTES} bytes")
    except TimeoutError:
        raise HTTPException(408, f"the body was not received within {BODY_TIMEOUT_S:g} s") from None
    return body
