"""Every command of `tactile`: its words, what it does, and the module that does it.

Nothing is imported here: `tactile --help` reads this table alone. A module has
`add_to(verbs)`, which adds the parser of the verb; `docs/reference/commands.md` is made from the
table (`make reference`).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """A row of the table."""

    words: str
    """What is typed after `tactile`: one word or two."""
    module: str
    """Whose `add_to` adds the verb."""
    help: str
    """What it does, in a line."""
    verb: str = ""
    """Its name in `python -m PACKAGE VERB`, where that is not the last word."""
    extra: str = ""
    """What to install for it, where that is not the extra of its package."""

    @property
    def package(self) -> str:
        """The package that it belongs to."""
        return self.module.partition(".")[0]

    @property
    def name(self) -> str:
        """Of the verb in its package."""
        return self.verb or self.words.split()[-1]

    @property
    def door(self) -> str:
        """The same command as a verb of its package."""
        return f"python -m {self.package} {self.name}"


RECORD = (
    Command("collect", "rig.cli.collect", "record one session along the bench's plan"),
    Command("home", "rig.cli.home", "find the sensor's surface by touch"),
    Command("calibrate-latency", "rig.cli.calibrate_latency", "find how late the camera is"),
    Command("force-depth", "rig.cli.force_depth", "press and release; table and curve"),
    Command("campaign", "rig.cli.campaign", "record what is left of a day of sessions"),
    Command("preview", "rig.cli.preview", "draw the plan and check its limits"),
    Command("jog", "rig.cli.jog", "move the arm by a SpaceMouse, take the contact origin"),
    Command("grip", "rig.cli.grip", "close the gripper on the indenter"),
    Command("mock", "rig.cli.mock", "run the emulators of a bench until Ctrl-C"),
    Command("replay", "rig.cli.replay", "play a session through the emulators, record it again"),
    Command("compare", "rig.cli.compare", "hold a mock session against the World's truth"),
    Command(
        "live", "rig.cli.live", "forces from the sensor as it is pressed", extra="rig,learning"
    ),
)
SESSIONS = (
    Command("session info", "recorder.__main__", "show what a session or an archive holds"),
    Command("session check", "recorder.__main__", "look for faults; exit 1 if there are any"),
    Command("session recover", "recorder.__main__", "close a session whose recording was killed"),
    Command("session repack", "recorder.__main__", "copy it, images stored in another way"),
    Command(
        "session export",
        "recorder.__main__",
        "write it as LeRobot, MCAP, HDF5 or GenForce",
        extra="export",
    ),
    Command("session sheet", "recorder.__main__", "draw it on one page"),
    Command("session view", "recorder.__main__", "look at it in Rerun", extra="view"),
    Command("import", "recorder.__main__", "wrap a recording made elsewhere into a session"),
)
SIMULATE = (
    Command("sim press", "sim.cli.press", "press straight down: force, surface, pressure"),
    Command("sim loop", "sim.cli.loop", "press, shear, return and release"),
    Command("sim hold", "sim.cli.hold", "press within a time and hold: relaxation"),
    Command("sim archive", "sim.cli.archive", "marker archives of simulated sensors"),
)
LEARN = (
    Command("markers", "learning.cli.markers", "make a marker archive of recorded sessions"),
    Command("split", "learning.cli.split", "say which presses train and which test"),
    Command(
        "train field",
        "learning.translation.field.command",
        "train the field translator",
        "train-field",
    ),
    Command(
        "train direct",
        "learning.translation.direct.command",
        "train the direct translator",
        "train-direct",
    ),
    Command(
        "train autoencoder",
        "learning.translation.direct.autoencoder_command",
        "train the images' autoencoder, which the direct translator builds on",
        "train-autoencoder",
    ),
    Command(
        "train diffusion",
        "learning.translation.diffusion.command",
        "train the paper's translator",
        "train-diffusion",
        "diffusion",
    ),
    Command(
        "train marker-vae",
        "learning.translation.diffusion.vae_command",
        "train the autoencoder that the paper's translator builds on",
        "train-marker-vae",
        "diffusion",
    ),
    Command("train force", "learning.force.command", "train a force model", "train-force"),
    Command("translate", "learning.cli.translate", "show frames of a sensor as another's"),
    Command("compensate", "learning.compensation.command", "bring labels from skin to skin"),
    Command("predict", "learning.cli.predict", "predict the forces of frames"),
    Command("evaluate", "learning.cli.evaluate", "report of predictions and translations"),
    Command("experiment", "learning.cli.experiment", "translate, train, evaluate: all pairs"),
    Command("import-genforce", "learning.cli.import_genforce", "published folders to an archive"),
    Command("export-genforce", "learning.cli.export_genforce", "an archive to a training folder"),
    Command(
        "import-weights",
        "learning.translation.diffusion.weights_command",
        "take published weights of the paper's translator",
        extra="diffusion",
    ),
    Command("export-onnx", "learning.cli.export_onnx", "write a force model as ONNX"),
)
LAB = (Command("init", "tactile.init", "lay out the folder of a lab"),)

GROUPS = {
    "Record": RECORD,
    "Sessions": SESSIONS,
    "Simulate": SIMULATE,
    "Learn": LEARN,
    "Lab": LAB,
}
COMMANDS = {command.words: command for group in GROUPS.values() for command in group}
# First words that are followed by a second one.
FAMILIES = {
    "session": "look after recorded sessions and marker archives",
    "sim": "press rigid indenters into a soft layer; lengths in mm, forces in N",
    "train": "train translators and force models",
}
# Whose `run(parser, argv)` runs the verbs of a package: its errors, its exit codes.
FRONTS = {
    "rig": "rig.cli.ending",
    "recorder": "recorder.__main__",
    "sim": "sim.cli.ending",
    "learning": "learning.command",
    "tactile": "tactile.init",
}
# What has to be installed for the verbs of a package.
EXTRAS = {"rig": "rig", "recorder": "", "sim": "sim", "learning": "learning", "tactile": ""}
