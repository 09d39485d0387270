"""beambox.train."""
