"""`python -m beambox` is the `beambox` command."""

from beambox.cli.main import main

if __name__ == "__main__":
    main()
