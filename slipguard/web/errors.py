"""Errors of the API: each is {"error": one line} with an HTTP status, described in the OpenAPI document."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import structlog
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

from slipguard.daemon.api.state import ErrorResponse
from slipguard.errors import CommandRefused, SlipguardError

STATUS_DESCRIPTIONS = {
    400: "The body is not JSON.",
    401: "TCP only: the token, or the page's cookie and session key, is missing or wrong.",
    403: "TCP only: the request comes from another web page, or names another host.",
    404: "Not found.",
    408: "The body was not received in time.",
    409: "Refused in the present state; nothing was changed.",
    413: "The body is too large.",
    422: "Invalid value; the text says what is allowed.",
    500: "Internal error of the daemon; its log has the details.",
    503: "A device or the daemon is not healthy, or there are too many requests.",
}
log = structlog.get_logger()


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return `responses=` of a route for these statuses, and for those that any request may get."""
    return {
        status: {"description": STATUS_DESCRIPTIONS[status], "model": ErrorResponse}
        for status in sorted({403, 503, *statuses})
    }


def error_response(status: int, text: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """Return an error in the form that all errors have."""
    return JSONResponse({"error": " ".join(text.split())}, status_code=status, headers=headers)


async def _refused(request: Request, raised: Exception) -> Response:
    return error_response(409, str(raised))


async def _failed(request: Request, raised: Exception) -> Response:
    return error_response(503, str(raised))


async def _bug(request: Request, raised: Exception) -> Response:
    path = request.url.path
    log.error("a request failed", path=path, exc_info=raised)
    return error_response(500, f"{path} failed inside the daemon ({type(raised).__name__}); see the daemon's log")


async def _bad_parameter(request: Request, raised: Exception) -> Response:
    """Return in one line what is wrong with a parameter of the address."""
    problems = raised.errors() if isinstance(raised, RequestValidationError) else []
    problem = problems[0] if problems else {"loc": ("request",), "msg": "invalid"}
    message = str(problem["msg"])
    return error_response(422, f"{problem['loc'][-1]}: {message[:1].lower()}{message[1:]}")


async def _http_exception(request: Request, raised: Exception) -> Response:
    """Return errors of the framework (unknown path, wrong method) in the same form."""
    status: Any = getattr(raised, "status_code", 500)
    detail = str(getattr(raised, "detail", ""))
    path = request.url.path
    if status == 404 and detail == "Not Found":
        detail = f"no such path {path}; /openapi.json lists all paths"
    elif status == 405:
        detail = f"{request.method} {path} is not possible; use GET to read and POST for commands"
        methods = {name for route in request.app.routes for name in _methods(route, request.scope)}
        return error_response(status, detail, {"allow": ", ".join(sorted(methods))})
    return error_response(status, detail, getattr(raised, "headers", None))


def _methods(route: BaseRoute, scope: Scope) -> Iterable[str]:
    """Return the methods of a route if it matches this path; two routes may share a path."""
    matches = route.matches(dict(scope))[0] is not Match.NONE
    return (getattr(route, "methods", None) or ()) if matches else ()


EXCEPTION_HANDLERS: dict[int | type[Exception], Callable[[Request, Exception], Coroutine[Any, Any, Response]]] = {
    CommandRefused: _refused,
    SlipguardError: _failed,
    HTTPException: _http_exception,
    RequestValidationError: _bad_parameter,
    Exception: _bug,
}
