"""Objects from sweep to sweep: identities, velocities, births and deaths; see docs/tracking.md.

>>> from beambox.track import Tracker
>>> tracker = Tracker(rate=10)
>>> for sweep in sweeps:
...     tracks = tracker.update(detector(sweep))
...     tracks.ids, tracks.velocities, tracks.detections.boxes
"""

from beambox.track.options import TrackerOptions
from beambox.track.poses import read_poses
from beambox.track.tracker import Tracker
from beambox.track.tracks import Tracks

__all__ = ["Tracker", "TrackerOptions", "Tracks", "read_poses"]
