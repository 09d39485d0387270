"""beambox.detectors."""
