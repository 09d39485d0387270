"""beambox.simulate."""
