"""`python -m pans.firmware_sim`: what `pans simulate` does, without looking at the other commands: it starts faster."""

import argparse
import gc
import sys

from pans.runtime.cli import EXIT_INTERRUPTED, say
from pans.runtime.errors import PansError


def main() -> int:
    """Run the simulator and return the exit code of the contract."""
    gc.disable()  # while all is loaded: nothing of it is garbage
    from pans.firmware_sim.commands.simulate import SIMULATE

    parser = argparse.ArgumentParser(prog="python -m pans.firmware_sim", description=SIMULATE.help)
    parser.set_defaults(json=False)
    SIMULATE.configure(parser)
    try:
        return SIMULATE.run(parser.parse_args())
    except PansError as error:
        say(f"pans: {error}")
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
