"""The command `export`: what leaves for other programs, a subcommand for each kind."""

from r2h_batch.base.command_line import Command
from r2h_batch.commands.real import real
from r2h_batch.commands.release import release
from r2h_batch.commands.scene import scene
from r2h_batch.commands.trials import trials
from r2h_batch.commands.views import views

COMMANDS: dict[str, Command] = {
    "trials": trials,
    "scene": scene,
    "release": release,
    "real": real,
    "views": views,
}
