"""The options of a detector, which every command that detects takes alike: spelled out once."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, get_type_hints

from beambox.cli import options

__all__ = ["DetectorOptions", "takes_detector_options"]


@dataclass(frozen=True)
class DetectorOptions:
    """What the command line says of a detector and of the points it is given; the names are those of the options."""

    range_: options.RangeOption = ""
    view: options.ViewOption = "auto"
    sensor_height: options.HeightOption = None
    axes: options.AxesOption = ""
    ground_slope: options.SlopeOption = ""
    intensity_scale: options.IntensityOption = None
    fields: options.FieldsOption = ""
    device: options.DeviceOption = "auto"
    precision: options.PrecisionOption = "auto"

    def for_load(self) -> dict[str, Any]:
        """Return the arguments of :func:`beambox.load`.

        Raises:
            BeamboxError: if a range or a slope cannot be read.
        """
        return {
            "range": options.parse_range(self.range_),
            "view": self.view,
            "sensor_height": self.sensor_height,
            "axes": self.axes or None,
            "ground_slope": options.parse_slope(self.ground_slope),
            "intensity_scale": self.intensity_scale,
            "fields": self.fields or None,
            "device": self.device,
            "precision": self.precision,
        }


def takes_detector_options(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command's last parameter, ``how: DetectorOptions``, stand for one option of each field."""
    hints = get_type_hints(command, include_extras=True)
    own = [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
        if name != "how"
    ]
    shared_hints = get_type_hints(DetectorOptions, include_extras=True)
    shared = [
        inspect.Parameter(
            one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default, annotation=shared_hints[one.name]
        )
        for one in fields(DetectorOptions)
    ]

    @functools.wraps(command)
    def called(**given: Any) -> None:
        how = DetectorOptions(**{one.name: given.pop(one.name) for one in shared})
        command(**given, how=how)

    called.__signature__ = inspect.Signature([*own, *shared])  # pyright: ignore[reportAttributeAccessIssue]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    del called.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]  # typer would read its annotations instead
    return called
