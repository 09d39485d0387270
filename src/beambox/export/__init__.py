"""beambox.export."""

from beambox.callable_package import make_callable

make_callable(__name__)  # beambox.export(...) is beambox.verbs.export
