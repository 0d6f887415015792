"""Entry point of the program: the worker process first, and in it the command line, which takes time to import."""

import os

from mitsim.core.worker import end_stopped, end_uncaught, end_with, enter_worker, pause_collector


def main() -> None:
    """:func:`mitsim.cli.run` in a worker process, whose death leaves a clear line and status."""
    try:
        enter_worker()
        # Pydantic would read the entry points of all installed packages, 20 ms, for plugins that nothing here uses.
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
        with pause_collector():
            from mitsim.cli import run
        run()
    except SystemExit as ended:
        end_with(ended.code)
        raise
    except KeyboardInterrupt:  # before the command line is there to take it
        end_stopped()
    except Exception as error:  # before the command line is there to take it
        end_uncaught(error)


if __name__ == "__main__":
    main()
