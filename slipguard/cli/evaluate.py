"""`slipguard evaluate`: experiments that compare estimated rotations with known ones, and their reports."""

from __future__ import annotations

import json as jsonlib
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.options import ClusterOption, JobsOption, JsonOption
from slipguard.cli.terminal import progress_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.evaluation.protocol import LiftProtocol

app = typer.Typer(
    help="Compare estimated rotations with known ones: the paper's grasp-and-lift experiment, with two markers and an "
    "external camera.\n\n"
    "Example: `slipguard evaluate run --sim --out eval/`, `slipguard evaluate report eval/`"
)


@app.command()
def markers(
    out: Annotated[Path, typer.Option(help="File to write: .pdf or .png (300 dpi), A4.")],
    charuco: Annotated[
        bool, typer.Option("--charuco", help="Write the calibration board instead of the two markers.")
    ] = False,
) -> None:
    """Write a sheet of markers to print at true scale, with a ruler to check the print.

    Example: `slipguard evaluate markers --out markers.pdf`
    """
    from slipguard.evaluation.markers import charuco_sheet, marker_sheet, write_sheet

    write_sheet(charuco_sheet() if charuco else marker_sheet(), out)
    print(f"{out}: print at 100 % and check the ruler")


@app.command("calibrate-camera")
def calibrate_camera(
    source: Annotated[Path, typer.Argument(help="Video, or folder of images, of the printed ChArUco board.")],
    out: Annotated[Path, typer.Option(help="File to write the intrinsics to (JSON).")],
    json: JsonOption = False,
) -> None:
    """Calibrate a camera from images of the printed board at different tilts and positions.

    Example: `slipguard evaluate calibrate-camera board.mp4 --out camera.json`
    """
    from slipguard.evaluation import camera_calibration
    from slipguard.evaluation.external_camera import timed_frames

    found = camera_calibration.calibrate_camera(image for _, image in timed_frames(source))
    try:
        out.write_text(found.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from None
    if json:
        print(found.model_dump_json())
        return
    print(
        f"{out}: {found.width_px}x{found.height_px}, focal length {found.focal_px:.1f} px, RMS error {found.rms_px} px"
    )


@app.command()
def rotation(
    source: Annotated[Path, typer.Argument(help="Video, folder of images, or recording of a lift (.mcap).")],
    intrinsics: Annotated[Path, typer.Option(help="Intrinsics of the camera, from `calibrate-camera`.")],
    side_mm: Annotated[
        float, typer.Option(min=5.0, max=300.0, help="Side of the markers' black squares, in millimeters.")
    ] = 40.0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per image and line.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Plot the rotation over time to a PNG.")] = None,
) -> None:
    """Measure the object's rotation in the gripper from the two markers, without tactile images.

    Example: `slipguard evaluate rotation lift.mp4 --intrinsics camera.json --plot rotation.png`
    """
    from slipguard.evaluation.camera_calibration import read_intrinsics
    from slipguard.evaluation.external_camera import markers_in
    from slipguard.evaluation.marker_rotation import rotations
    from slipguard.evaluation.report_plots import draw_trace
    from slipguard.tools.plotting import check_plot_path

    check_plot_path(plot)
    lens = read_intrinsics(intrinsics)
    seen = list(markers_in(source, lens))
    try:
        trace = rotations(seen, lens, side_mm)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    if json:
        for time_s, rotation_deg, sigma_deg in zip(trace.time_s, trace.rotation_deg, trace.sigma_deg, strict=True):
            print(
                jsonlib.dumps(
                    {"time_s": round(time_s, 4), "turn_deg": round(rotation_deg, 3), "sigma_deg": round(sigma_deg, 3)}
                )
            )
    else:
        largest = max(trace.rotation_deg, key=abs)
        print(
            f"{len(trace.time_s)} of {len(seen)} images show both markers; rotation from "
            f"{trace.rotation_deg.min():+.2f}° to {trace.rotation_deg.max():+.2f}°, largest {largest:+.2f}°, "
            f"sigma {trace.sigma_deg.mean():.2f}°, RMS error of the corners {trace.rms_px:.2f} px"
        )
    if plot is not None:
        draw_trace(trace, plot)


@app.command()
def run(
    out: Annotated[Path, typer.Option(help="Folder of the experiment. A run that was stopped is continued.")],
    sim: Annotated[bool, typer.Option("--sim", help="Simulate the cell and its camera.")] = False,
    config: Annotated[Path | None, typer.Option(help="The cell's configuration.")] = None,
    protocol: Annotated[
        Path | None, typer.Option(help="Lifts to perform (TOML). Default with --sim: 45 lifts.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="External camera: number, /dev/videoN or URL. Without it, add the videos to the folder later."
        ),
    ] = None,
    intrinsics: Annotated[Path | None, typer.Option(help="Intrinsics of that camera, from `calibrate-camera`.")] = None,
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
    json: JsonOption = False,
) -> None:
    """Perform the experiment, one recording per lift, and write the report. On a real cell, you place each object.

    Example: `slipguard evaluate run --sim --out eval/`,
    `slipguard evaluate run --config config.toml --protocol p.toml --camera 4 --intrinsics camera.json --out eval/`
    """
    from slipguard.evaluation.experiment import run_simulated
    from slipguard.evaluation.protocol import SIMULATED, read_protocol
    from slipguard.tools.parallel import Workers

    plan = SIMULATED if protocol is None else read_protocol(protocol)
    workers = Workers(jobs, cluster)
    if sim:
        if config is not None or camera is not None or intrinsics is not None:
            raise InputError("--sim simulates the cell and the camera; omit --config, --camera and --intrinsics")
        _check_objects(plan)
        with progress_bar("lifts") as show:
            run_simulated(out, plan, workers, lambda share: show("lifts", share))
    else:
        _run_on_cell(out, plan if protocol is not None else None, config, camera, intrinsics)
    _report(out, workers, json)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of an experiment.")],
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
    json: JsonOption = False,
) -> None:
    """Write the report of an experiment again: report.html, report.json and plots.

    Example: `slipguard evaluate report eval/`
    """
    from slipguard.tools.parallel import Workers

    _report(folder, Workers(jobs, cluster), json)


def _report(folder: Path, workers: Any, json: bool) -> None:
    from slipguard.evaluation.experiment import PAGE, write_report

    with progress_bar("results") as show:
        figures = write_report(folder, workers, lambda share: show("results", share))
    if json:
        print(jsonlib.dumps(figures))
        return
    _print_table(figures)
    print(f"report: {folder / PAGE}")


def _print_table(figures: dict[str, Any]) -> None:
    from rich.console import Console

    from slipguard.tools.figures import figure_table, text

    rows = [
        (
            name + (f" ({one['hard']})" if one["hard"] else ""),
            str(one["fused"]["n"]),
            text(one["fused"]["mean"]) + " ± " + text(one["fused"]["sd"]),
            text(one["fused"]["worst"]),
            f"{100 * one['declined_share']:.0f} %",
        )
        for name, one in figures["per_object"].items()
    ]
    console = Console(highlight=False)
    console.print(figure_table(("object", "lifts", "error ° mean ± sd", "worst lift", "no estimate"), rows))
    if figures["turn_error_mean_deg"] is None:
        console.print("no lift could be compared; see `problems` in report.json")
        return
    paper = figures["paper_real_cell_as_published"]
    mean_deg, sd_deg = figures["turn_error_mean_deg"], figures["turn_error_sd_deg"]
    console.print(
        f"{figures['lifts_compared']} lifts: {mean_deg:.2f}° ± {sd_deg:.2f}°, worst object "
        f"{figures['turn_error_worst_object_deg']:.2f}°; paper, real cell: "
        f"{paper['turn_error_mean_deg']}° ± {paper['turn_error_sd_deg']}°"
        + (" (this cell is simulated; not comparable)" if figures["simulated"] else "")
    )


def _check_objects(plan: LiftProtocol) -> None:
    from slipguard.sim.catalogue import object_names

    known = {*object_names("test"), *object_names("train")}
    for one in plan.objects:
        if one.name not in known:
            raise InputError(f"no simulated object {one.name!r}; choose from: {', '.join(sorted(known))}")


def _run_on_cell(
    out: Path, plan: LiftProtocol | None, config: Path | None, camera: str | None, intrinsics: Path | None
) -> None:
    import asyncio

    from slipguard.cli.interrupt import default_interrupts
    from slipguard.cli.terminal import ask
    from slipguard.config import read_config
    from slipguard.daemon.api.paths import socket_path
    from slipguard.daemon.run import build_service
    from slipguard.daemon.store.last_grasp import LastGraspSaver
    from slipguard.daemon.store.state_dir import StateDir
    from slipguard.evaluation.camera_calibration import read_intrinsics
    from slipguard.evaluation.external_camera import ExternalCamera
    from slipguard.evaluation.real_lifts import daemon_socket_held, run_on_cell

    if config is None or plan is None or intrinsics is None:
        raise InputError("a real cell needs --config, --protocol and --intrinsics; --sim does not need them")
    settings = read_config(config)
    service, lens = build_service(settings), read_intrinsics(intrinsics)
    service.observers.append(
        LastGraspSaver(
            StateDir(settings.state.directory), service.event_log.info, service.event_log.warning
        ).add_decision
    )
    with daemon_socket_held(socket_path(settings)):
        external = nullcontext() if camera is None else ExternalCamera(camera, lens)
        with external as eye, default_interrupts():
            asyncio.run(run_on_cell(out, plan, service, eye, lens, ask))
