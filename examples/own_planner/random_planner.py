"""A planner of your own: every robot goes to a candidate drawn at random."""

import numpy as np

from maasi_filter.settings import Settings
from maasi_planner.planners.base import Planner, options_of, waiting_places
from maasi_planner.team import Decision, single_choice, stay


class RandomPlanner(Planner):
    class Settings(Settings):
        seed: int = 1

    def decide(self, team):
        decision = Decision(team.step)
        random = np.random.default_rng([self.own.seed, team.step])
        places = waiting_places(team)
        for name in team.planning():
            options = options_of(team, name, places)
            if isinstance(options, str):  # why there is nothing to choose from
                decision.robots[name] = stay(team.robots[name], options)
                continue
            chosen = int(random.choice(np.flatnonzero(options.allowed)))
            places.append((options.points[chosen], team.robots[name].radius))
            decision.robots[name] = single_choice(
                options.points, options.prediction, chosen, 'drawn at random'
            )
        return decision
