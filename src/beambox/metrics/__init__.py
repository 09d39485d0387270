"""beambox.metrics."""
