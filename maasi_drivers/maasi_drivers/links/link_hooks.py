"""What the driver asks a link that only one kind of robot needs."""

# Hooks do nothing.

from collections.abc import Sequence

from maasi_drivers.agent.waypoint_follower import Goal


class LinkHooks:
    """Hooks of a link, each for one kind of robot; the others leave them as they are."""

    # ---- autopilots, Nav2 and the Mambo --------------------------------------------------------

    def expects_pose(self) -> bool:
        """Return whether a missing first pose is worth a warning."""
        return True

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Return why a waypoint (x, y, z) [m, map] inside the volume is refused, or None."""
        return None

    def goal_ended(self, goal: Goal) -> None:
        """Take note that a goal has ended, before its result is sent."""

    def goal_cancelled(self) -> None:
        """Take note that a client cancelled the goal, after `hold`."""

    # ---- robots that a simulation moves in steps -----------------------------------------------

    def begin_step(self, stamp: int) -> None:
        """Take in what is older than the step at `stamp` [ns], before its control step."""

    def repeat(self) -> None:
        """Send the last command again: a peer that was restarted may have missed it."""
