"""beambox.zoo."""
