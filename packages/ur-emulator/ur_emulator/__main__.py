"""The command `ur-emulator` as `python -m ur_emulator`."""

from ur_emulator.cli import main

if __name__ == "__main__":
    main()
