"""beambox.train."""

from beambox.callable_package import make_callable

make_callable(__name__)  # beambox.train(...) is beambox.verbs.train
