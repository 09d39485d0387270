"""beambox.cli."""
