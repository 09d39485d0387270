"""`beambox serve`: detection over HTTP."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli import options
from beambox.cli.console import announce, log, show_log

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    model: options.DefaultModelOption = "",
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="Address to listen at; 0.0.0.0 is all of them.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="Port; 0 takes a free one.")] = 8080,
    batch_size: Annotated[
        int, typer.Option("--batch", min=1, metavar="N", help="Requests that go through the network together.")
    ] = 4,
    batch_wait: Annotated[
        float, typer.Option("--batch-wait", min=0, metavar="MS", help="Milliseconds that the first waits for others.")
    ] = 5.0,
    max_mb: Annotated[float, typer.Option("--max-mb", min=0.001, metavar="MB", help="Largest body.")] = 32.0,
    max_points: Annotated[int, typer.Option("--max-points", min=1, metavar="N", help="Points of a sweep.")] = 1_000_000,
    max_waiting: Annotated[
        int, typer.Option("--max-waiting", min=1, metavar="N", help="Requests in work; more are answered 503.")
    ] = 16,
    body_seconds: Annotated[
        float, typer.Option("--body-seconds", min=0.1, metavar="S", help="Time for a body to arrive.")
    ] = 20.0,
    answer_seconds: Annotated[
        float, typer.Option("--answer-seconds", min=0.1, metavar="S", help="Time for an answer.")
    ] = 60.0,
    range_: options.RangeOption = "",
    sensor_height: options.HeightOption = None,
    axes: options.AxesOption = "",
    ground_slope: options.SlopeOption = "",
    intensity_scale: options.IntensityOption = None,
    fields: options.FieldsOption = "",
    device: options.DeviceOption = "auto",
    precision: options.PrecisionOption = "auto",
) -> None:
    """Answer HTTP requests: POST /detect takes the bytes of a sweep and gives JSON as `beambox detect` writes it.

    Examples:
      beambox serve --model pointpillars-kitti
      curl --data-binary @scan.bin "http://127.0.0.1:8080/detect?score_threshold=0.3"
      curl --data-binary @scan.pcd "http://127.0.0.1:8080/detect?format=pcd&frame=000123"
      curl http://127.0.0.1:8080/model

    GET /health tells whether it works. There is no encryption and no password: beyond this machine, put it behind a
    proxy that has them.
    """
    from beambox.serve.app import create_app, expect_installed
    from beambox.serve.limits import ServeLimits

    expect_installed()
    parsed_range, slope = options.parse_range(range_), options.parse_slope(ground_slope)
    limits = ServeLimits(
        max_bytes=int(max_mb * 1e6),
        max_points=max_points,
        max_waiting=max_waiting,
        body_seconds=body_seconds,
        answer_seconds=answer_seconds,
    )
    listening = listen(host, port)  # before the network is loaded, which takes seconds
    model = options.model_or_default(model)

    from beambox.infer.predictor import load

    show_log()
    detector = load(
        model,
        device=device,
        precision=precision,
        range=parsed_range,
        view="full",  # a sweep comes without its calibration
        sensor_height=sensor_height,
        axes=axes or None,
        ground_slope=slope,
        intensity_scale=intensity_scale,
        fields=fields or None,
    )
    app = create_app(detector, Path(model).name, limits, batch_size=batch_size, batch_wait=batch_wait / 1000)
    address, number = listening.getsockname()[:2]
    shown = f"[{address}]" if ":" in address else address
    announce("serve", detail=f"{model} on {detector.device}, http://{shown}:{number}; Ctrl-C ends it")
    run(app, listening, limits.max_connections)


def listen(host: str, port: int) -> socket.socket:
    """Open the socket.

    Raises:
        BeamboxError: if the address is not this machine's, or the port is taken.
    """
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, number)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen()
    except OSError as error:
        raise BeamboxError(
            f"cannot listen at {host} port {port}: {error.strerror or error}; give another --host or --port"
        ) from None
    return listening


def run(app: object, listening: socket.socket, connections: int) -> None:
    """Serve until a signal comes."""
    import uvicorn

    config = uvicorn.Config(
        app,  # pyright: ignore[reportArgumentType]
        log_level="warning",
        access_log=False,
        server_header=False,
        limit_concurrency=connections,
        timeout_graceful_shutdown=10,
        ws="none",
    )
    try:
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:  # uvicorn hands the signal on once all is closed
        pass
    log("stopped")
