"""The operator page: its files, and the way in that gives a browser control."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse, RedirectResponse
from starlette.staticfiles import StaticFiles

from slipguard.errors import CommandRefused
from slipguard.web import models as b
from slipguard.web.access import CODE_S, COOKIE
from slipguard.web.commands import SECURITY
from slipguard.web.errors import error, error_responses, with_error_response
from slipguard.web.route_context import RouteContext

PAGE = Path(__file__).parent / "page"


def add_page(app: FastAPI, room: RouteContext) -> None:
    """`/`, its files under `/page/`, `/login`, and `/page-link`, which makes the links that `/login` takes."""

    @app.get("/", include_in_schema=False)
    async def page() -> Response:
        return FileResponse(PAGE / "index.html")

    app.mount("/page", StaticFiles(directory=PAGE), name="page")

    @app.get("/login", status_code=303, response_class=Response, responses=error_responses(401, 422))
    async def login(request: Request, token: Annotated[str, Query(max_length=200)]) -> Response:
        """Give the browser that opens a link from `/page-link` control of the page. A link works once."""
        cookie = room.access.redeem(token) if room.access is not None else None
        if room.access is None or cookie is None:
            if "text/html" in request.headers.get("accept", ""):
                return FileResponse(PAGE / "link_used.html", status_code=401)
            return error(401, "this link was used, or is too old; `slipguard ctl page` makes another")
        answer = RedirectResponse(f"/#session={room.access.session}", status_code=303)  # a fragment is sent nowhere
        answer.set_cookie(COOKIE, cookie, httponly=True, samesite="strict", path="/")
        return answer

    @app.post(
        "/page-link",
        response_model=b.PageLink,
        responses=error_responses(401, 409),
        openapi_extra={"security": SECURITY},
    )
    async def page_link() -> Response:
        """Make a link that gives the browser that opens it first control of the page."""

        async def make() -> Response:
            if room.access is None:
                raise CommandRefused("the page is not served; set api.listen, and see the daemon's log")
            url = room.access.link()
            return JSONResponse({"said": url, "url": url, "valid_s": CODE_S})

        return await with_error_response("/page-link", make())
