"""What may differ from the twin, and what each change does to a session, calibration taking in its part."""
