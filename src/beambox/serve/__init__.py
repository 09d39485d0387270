"""Detection over HTTP: POST a sweep, get JSON; needs the extra `serve`."""
