"""Hooks of a link that only one kind of robot needs."""

# Hooks do nothing.

from collections.abc import Sequence

from maasi_drivers.agent.waypoint_follower import Goal


class LinkHooks:
    """Optional hooks of a link."""

    # ---- autopilots, Nav2 and the Mambo --------------------------------------------------------

    def expects_pose(self) -> bool:
        """Return whether to warn about a missing first pose."""
        return True

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Return why a waypoint (x, y, z) [m, map] inside the volume is refused, or None."""
        return None

    def goal_ended(self, goal: Goal) -> None:
        """Handle the end of a goal, before its result is sent."""

    def goal_cancelled(self) -> None:
        """Handle the cancellation of the goal by a client, after `hold`."""

    # ---- robots that a simulation moves in steps -----------------------------------------------

    def begin_step(self, stamp: int) -> None:
        """Process data older than the step at `stamp` [ns], before its control step."""

    def repeat(self) -> None:
        """Send the last command again: a restarted peer may have missed it."""
