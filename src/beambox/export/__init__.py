"""beambox.export."""
