"""beambox.data."""
