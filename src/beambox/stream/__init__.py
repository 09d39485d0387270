"""Recordings in, the same recordings' boxes out, each read once; see docs/streams.md."""
