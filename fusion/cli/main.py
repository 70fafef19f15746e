"""The command `fusion`: one error boundary; each command is imported only when it is called."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version

from cyclopts import App, CycloptsError, Parameter

from fusion.errors import FusionError

app = App(
    name="fusion",
    help="Fused RGB-thermal frames for trackers. Start with: fusion blend RGB FIR -o OUT --preview",
    version=lambda: version("fusionprep"),
    help_format="plaintext",
    default_parameter=Parameter(negative=()),
)
app.command("fusion.cli.blend:blend", name="blend", help="Fuse RGB and thermal images into a folder.")
datasets = App(name="datasets", help="List and show the data sets whose layout is known.")
datasets.command("fusion.cli.datasets:list_datasets", name="list", help="List the known data sets.")
datasets.command("fusion.cli.datasets:show_dataset", name="show", help="Show one data set: layout, licence, source.")
app.command(datasets)
simulate = App(name="simulate", help="Make sample data with the truth beside it.")
simulate.command("fusion.cli.simulate:simulate_pairs", name="pairs", help="Make unregistered RGB-thermal pairs.")
app.command(simulate)

USAGE, INTERRUPTED, INTERNAL = 2, 130, 70


def main() -> None:
    """Run the command line and exit: 0 done, 1 input or output is at fault, 2 the options are."""
    sys.exit(_guarded())


def _guarded() -> int:
    try:
        app(exit_on_error=False, print_error=False)
    except CycloptsError as error:
        return _complain(f"{' '.join(str(error).split())} (fusion COMMAND --help shows the options)", USAGE)
    except FusionError as error:
        return _complain(str(error), error.exit_code)
    except KeyboardInterrupt:
        return _complain("interrupted; the same command goes on where this one stopped", INTERRUPTED)
    except MemoryError:
        return _complain("out of memory (try fewer --workers)", 1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # whoever read us has left: say no more
        return 0
    except OSError as error:
        return _complain(f"{error.filename or 'system'}: {error.strerror or error}", 1)
    except Exception as error:
        if os.environ.get("FUSION_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        return _complain(f"a fault of fusion's own: {what} (please report it; FUSION_DEBUG=1 shows more)", INTERNAL)
    return 0


def _complain(text: str, exit_code: int) -> int:
    print(f"fusion: {text}", file=sys.stderr)
    return exit_code
