"""beambox.data.formats."""
