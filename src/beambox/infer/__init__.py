"""beambox.infer."""
