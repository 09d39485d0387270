"""beambox.visualize."""
