"""The operator page: its files, and the login that gives a browser control."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse, RedirectResponse
from starlette.staticfiles import StaticFiles

from slipguard.daemon.api.state import PageLink
from slipguard.errors import CommandRefused
from slipguard.web.access import COOKIE, LINK_VALID_S
from slipguard.web.commands import SECURITY
from slipguard.web.errors import error_response, error_responses
from slipguard.web.route_context import RouteContext

PAGE = Path(__file__).parent / "page"


def add_page(app: FastAPI, context: RouteContext) -> None:
    """Add `/`, its files under `/page/`, `/page-link`, which makes login links, and `/login`, which accepts them."""

    @app.get("/", include_in_schema=False)
    async def page() -> Response:
        return FileResponse(PAGE / "index.html")

    app.mount("/page", StaticFiles(directory=PAGE), name="page")

    @app.get("/login", status_code=303, response_class=Response, responses=error_responses(401, 422))
    async def login(request: Request, token: Annotated[str, Query(max_length=200)]) -> Response:
        """Give the browser that opens a link from `/page-link` control over the page. A link works once."""
        cookie = context.access.redeem(token) if context.access is not None else None
        if context.access is None or cookie is None:
            if "text/html" in request.headers.get("accept", ""):
                return FileResponse(PAGE / "link_used.html", status_code=401)
            return error_response(401, "this link was used or has expired; `slipguard ctl page` prints a new one")
        # Browsers do not send the fragment to any server.
        response = RedirectResponse(f"/#session={context.access.session_key}", status_code=303)
        response.set_cookie(COOKIE, cookie, httponly=True, samesite="strict", path="/")
        return response

    @app.post(
        "/page-link",
        response_model=PageLink,
        responses=error_responses(401, 409),
        openapi_extra={"security": SECURITY},
    )
    async def page_link() -> Response:
        """Make a link that gives the first browser that opens it control over the page."""

        if context.access is None:
            raise CommandRefused("the page is not served; set api.listen, and check the daemon's log")
        url = context.access.make_link()
        return JSONResponse({"message": url, "url": url, "valid_s": LINK_VALID_S})
