"""beambox.layers."""
