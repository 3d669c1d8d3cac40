"""`python -m pans_sim`: what `pans simulate` does, without looking at the other commands: it starts faster."""

import argparse
import gc
import sys

from pans.base.console import say
from pans.base.errors import EXIT_INTERRUPTED, PansError


def main() -> int:
    """Run the simulator and return the exit code of the contract."""
    gc.disable()  # while all is loaded: nothing of it is garbage
    from pans_sim.commands.simulate import SIMULATE

    parser = argparse.ArgumentParser(prog="python -m pans_sim", description=SIMULATE.help)
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
