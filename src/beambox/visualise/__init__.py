"""beambox.visualise."""
