"""Every failure as {"error": one line} with its status, and how that is described in the OpenAPI document."""

from __future__ import annotations

from collections.abc import Awaitable, Iterable
from typing import Any

import structlog
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.models import ErrorResponse

MEANS = {
    400: "The body is no JSON.",
    401: "On TCP: neither the token nor the whole login of the page came with it.",
    403: "On TCP: the request comes from a foreign page, or asks for another host.",
    404: "There is no such thing.",
    408: "The body did not come in time.",
    409: "Refused as things stand; the state is unchanged.",
    413: "The body is too large.",
    422: "Not what is allowed; the line says what is.",
    500: "A mistake in the daemon; its log says more.",
    503: "A device or the daemon is not well, or too many ask at once.",
}
log = structlog.get_logger()


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """For `responses=` of a route; what the gate may say on TCP is added."""
    return {status: {"description": MEANS[status], "model": ErrorResponse} for status in sorted({403, 503, *statuses})}


def error(status: int, text: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """The one form of all failures."""
    return JSONResponse({"error": " ".join(text.split())}, status_code=status, headers=headers)


async def with_error_response(path: str, answer: Awaitable[Response]) -> Response:
    """The answer, or why there is none."""
    try:
        return await answer
    except CommandRefused as refused:
        return error(409, str(refused))
    except SlipguardError as trouble:
        return error(503, str(trouble))
    except HTTPException:
        raise
    except Exception as mistake:
        log.exception("a request failed", path=path)
        return error(500, f"{path} failed inside the daemon ({type(mistake).__name__}); its log says more")


async def http_error(request: Request, raised: Exception) -> Response:
    """The framework's own errors (no such path, wrong method) in the same form."""
    status: Any = getattr(raised, "status_code", 500)
    detail = str(getattr(raised, "detail", ""))
    path = request.url.path
    if status == 404 and detail == "Not Found":
        detail = f"no such path {path}; /openapi.json tells all there are"
    elif status == 405:
        detail = f"{request.method} {path} is not possible; what only tells takes GET, commands POST"
        methods = {name for route in request.app.routes for name in _methods(route, request.scope)}
        return error(status, detail, {"allow": ", ".join(sorted(methods))})
    return error(status, detail, getattr(raised, "headers", None))


def _methods(route: BaseRoute, scope: Scope) -> Iterable[str]:
    """What a route takes at this path; two routes may share one."""
    matches = route.matches(dict(scope))[0] is not Match.NONE
    return (getattr(route, "methods", None) or ()) if matches else ()
