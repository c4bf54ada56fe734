"""The ``active6d`` command: one file per subcommand. Slow imports are inside the functions that need them."""

import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

from active6d_core.interrupts import INTERRUPTED
from active6d_core.ros.network import keep_on_this_machine, open_to_network
from active6d_tools.cli import (
    ablate,
    bags,
    bank,
    benchmark,
    benchmark_arm,
    benchmark_camera_errors,
    benchmark_estimator,
    benchmark_fusion,
    doctor,
    episode,
    estimate,
    evaluate,
    list_parts,
    objects,
    replay,
    report,
    scenes,
    train_estimator,
    train_fusion,
    train_policy,
)


class CommandGroup(TyperGroup):
    """Reports bad input in one line on standard error and exits with code 2."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Raises:
            typer.Exit: with code 2 after bad input.
        """
        try:
            return super().invoke(ctx)
        except TyperException as error:
            context = getattr(error, "ctx", None) or ctx
            self._refuse(f"{error.format_message()} (see {context.command_path} --help)", error)
        except BrokenPipeError:
            raise
        except KeyboardInterrupt:
            typer.echo("active6d: interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None
        # The packages raise these two for a wrong name, file or parameter; the message is one line.
        except (ValueError, OSError) as error:
            self._refuse(str(error), error)
        except typer.Exit:
            raise
        # Whatever else goes wrong is a defect, and a user gets one line for it as well.
        except Exception as error:
            self._refuse(f"internal error: {type(error).__name__}: {error} (active6d --debug shows where)", error, 1)

    @staticmethod
    def _refuse(text: str, error: Exception, code: int = 2) -> None:
        if os.environ.get("ACTIVE6D_TRACEBACK"):
            raise error
        typer.echo(f"active6d: {' '.join(text.split())}", err=True)
        raise typer.Exit(code) from error


class PartsCommand(TyperCommand):
    """A command whose help names all parts where its texts say {policies}, {estimators} or {sensors}."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Fill in the names, which are found only now: finding them imports the packages."""
        from active6d_agent.policies.registry import list_policies
        from active6d_perception.estimators.registry import list_estimators
        from active6d_sim.rendering.sensor_registry import list_sensors

        kinds = {"{policies}": list_policies, "{estimators}": list_estimators, "{sensors}": list_sensors}
        options: list[Any] = self.params
        for parameter in options:
            text = getattr(parameter, "help", None) or ""
            for kind, names in kinds.items():
                if kind in text:
                    parameter.help = text.replace(kind, ", ".join(names()))
        super().format_help(ctx, formatter)


app = typer.Typer(
    cls=CommandGroup,
    invoke_without_command=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    help="Estimate the 6D pose of every object in a bin; move the camera to the view that helps most.\n\n"
    "Example: [bold]active6d episode --object mug --seed 7 --policy lowest-score --bag bags/mug[/bold]",
    epilog="active6d --debug COMMAND shows the full traceback of an error. --network lets other machines in.",
)


@app.callback()
def show_help(
    ctx: typer.Context,
    network: Annotated[bool, typer.Option("--network", help="Let other machines reach the nodes.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let object descriptions name meshes outside of their folder.")
    ] = False,
) -> None:
    """Show the help if no command is given."""
    if debug:
        os.environ["ACTIVE6D_TRACEBACK"] = "1"
    if outside:
        os.environ["ACTIVE6D_ALLOW_OUTSIDE"] = "1"
    (open_to_network if network else keep_on_this_machine)()
    if ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())


app.command()(doctor.doctor)
app.command(cls=PartsCommand)(episode.episode)
app.command(cls=PartsCommand)(estimate.estimate)
app.command(cls=PartsCommand)(replay.replay)
app.command()(report.report)
app.command(cls=PartsCommand)(bank.bank)
app.command(cls=PartsCommand)(evaluate.evaluate)
app.command(cls=PartsCommand)(ablate.ablate)
app.command("list")(list_parts.list_parts)
app.add_typer(bags.app, name="bag")
app.add_typer(objects.app, name="object")
for command in scenes.app.registered_commands:
    command.cls = PartsCommand
app.add_typer(scenes.app, name="scenes")
benchmark.app.command(cls=PartsCommand)(benchmark_arm.arm)
benchmark.app.command(cls=PartsCommand)(benchmark_camera_errors.camera_errors)
benchmark.app.command(cls=PartsCommand)(benchmark_estimator.estimator)
benchmark.app.command(cls=PartsCommand)(benchmark_fusion.fusion)
benchmark.app.command(cls=PartsCommand)(benchmark.pipeline)
app.add_typer(benchmark.app, name="benchmark")
train_estimator.app.command(cls=PartsCommand)(train_fusion.fusion)
train_estimator.app.command()(train_policy.policy)
app.add_typer(train_estimator.app, name="train")


def main() -> None:
    """Entry point of the ``active6d`` executable."""
    sys.exit(app(prog_name="active6d"))
