"""Table of all commands: name, help text and implementing module.

No package is imported here: `tactile --help` needs only this table. `docs/reference/commands.md` is
generated from it (`make reference`).
"""

from typing import NamedTuple


class Command(NamedTuple):
    """One row of the table."""

    words: str
    """Words typed after `tactile`: one or two."""
    module: str
    """Module with `add_arguments` and `run`."""
    help: str
    """One-line help text."""
    extra: str = ""
    """Required extra, if different from the package's."""

    @property
    def package(self) -> str:
        """Package of the command."""
        return self.module.partition(".")[0]


RECORD = (
    Command("collect", "rig.cli.collect", "record one session with the bench's plan"),
    Command(
        "home", "rig.cli.home", "find the sensor's surface by touch (1 mm/s) and store its position"
    ),
    Command(
        "calibrate-latency",
        "rig.cli.calibrate_latency",
        "measure and store the latency of the camera or taxels by light taps",
    ),
    Command(
        "force-depth",
        "rig.cli.force_depth",
        "press and release along the bench's force_depth and plot the curve",
    ),
    Command("campaign", "rig.cli.campaign", "record the remaining sessions of a campaign file"),
    Command("doctor", "rig.cli.doctor", "test all devices of a bench, its plan, and the computer"),
    Command("setup", "rig.cli.setup", "set a bench up step by step, and write its acceptance"),
    Command(
        "jog",
        "rig.cli.jog",
        "move the arm with a SpaceMouse; its first button sets the contact origin",
    ),
    Command("grip", "tactile.grip", "open the gripper, then close it on the indenter", "rig"),
    Command("mock", "rig.cli.mock", "run the emulators of a bench until Ctrl-C"),
    Command(
        "replay",
        "rig.cli.replay",
        "play a session through the emulators and record it again; nothing moves",
    ),
    Command(
        "live",
        "rig.cli.live",
        "predict forces with a trained model as the sensor is touched; nothing moves",
        extra="rig,learning",
    ),
    Command(
        "page",
        "rig.cli.page",
        "serve the lab's page: sessions, replay, campaigns and set-up in the browser",
    ),
)
SESSIONS = (
    Command(
        "session list",
        "recorder.cli.list_sessions",
        "list the sessions below a folder, by sensor, indenter, date, status, faults",
    ),
    Command(
        "session info",
        "recorder.cli.info",
        "show the contents of a session or a marker archive; draw a session",
    ),
    Command(
        "session check",
        "recorder.cli.check",
        "check a session or a marker archive for problems; exit 1 if any is found",
    ),
    Command(
        "session recover",
        "recorder.cli.recover",
        "close a session that was killed, or make its lost manifest again",
    ),
    Command(
        "session export",
        "recorder.cli.export",
        "write a session as Zarr, LeRobot, MCAP, HDF5 or GenForce",
        extra="export",
    ),
    Command(
        "import",
        "tactile.import_recording",
        "make sessions of recordings made elsewhere, whatever their files are",
    ),
)
SIMULATE = (
    Command("sim press", "sim.cli.press", "press, hold and shear: force, surface, pressure"),
    Command("sim archive", "sim.cli.archive", "write marker archives of simulated sensors"),
    Command("sim labels", "sim.cli.labels", "add the forces of a sensor's twin to an archive"),
    Command("twin plan", "sim.cli.twin_plan", "choose the presses that identify a twin best"),
    Command("twin fit", "sim.cli.twin_fit", "identify a simulated twin of a sensor from presses"),
)
LEARN = (
    Command("markers", "learning.cli.markers", "make a marker archive of recorded sessions"),
    Command(
        "markers-fit",
        "learning.cli.markers_fit",
        "fit marker detection to pictures without contact",
    ),
    Command(
        "archive join",
        "learning.cli.archive_join",
        "join sensors of several archives: presses match by place, depth, direction",
    ),
    Command(
        "train field",
        "learning.translation.field.command",
        "train the field translator on a group of sensors",
    ),
    Command(
        "train diffusion",
        "learning.translation.diffusion.command",
        "train the paper's translator from SD-Turbo's weights",
        extra="diffusion",
    ),
    Command("train force", "learning.force.command", "train a force model on labelled presses"),
    Command(
        "translate",
        "learning.cli.translate",
        "translate frames of one sensor into frames of another",
    ),
    Command(
        "compensate",
        "learning.compensation.command",
        "fit material priors and choose how labels are scaled between skins",
    ),
    Command("predict", "learning.cli.predict", "predict the forces of frames"),
    Command(
        "evaluate",
        "learning.cli.evaluate",
        "report on predictions, translations and force models",
    ),
    Command(
        "experiment",
        "learning.cli.experiment",
        "translate, train, compensate and evaluate all pairs of an archive",
    ),
    Command(
        "force",
        "tactile.force",
        "make a force model of a sensor by the best way its data allow",
        extra="learning,sim",
    ),
    Command(
        "calibrate-force",
        "learning.cli.calibrate_force",
        "set the scale of such a model by weights laid on the sensor",
    ),
)
LAB = (Command("init", "tactile.init", "create the folder of a lab"),)

GROUPS = {"Record": RECORD, "Sessions": SESSIONS, "Simulate": SIMULATE, "Learn": LEARN, "Lab": LAB}
COMMANDS = {command.words: command for group in GROUPS.values() for command in group}
# First words of two-word commands.
FAMILIES = {
    "session": "inspect, check and convert sessions and marker archives",
    "archive": "join marker archives",
    "sim": "press rigid indenters into a soft layer; lengths in mm, forces in N",
    "twin": "identify a simulated twin of a sensor from its own presses",
    "train": "train translators and force models",
}
# Extras that the commands of a package need.
EXTRAS = {"rig": "rig", "recorder": "", "sim": "sim", "learning": "learning", "tactile": ""}
# Consequence of Ctrl-C for the commands of a package.
INTERRUPTED = {
    "rig": "nothing was recorded",
    "sim": "nothing was written",
    "learning": "repeat the command; an archive or an experiment is continued",
}
