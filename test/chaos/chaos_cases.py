"""The cases of the fault campaign, and the guarantee for each."""

from dataclasses import dataclass

from maasi_sim.simulation.emulators.mambo.fake_mambo import free_port

SEARCH_NODES = (
    '/sim_node',
    '/mambo/driver',
    '/mambo/guard',
    '/turtlebot/driver',
    '/turtlebot/guard',
    '/filter_node',
    '/planner_node',
)
MAVLINK_NODES = ('/drone/driver', '/filter_node', '/planner_node')
BUILDING_NODES = ('/sim_node', '/red/cuboid_planner')
_PAIRS = (
    ('/filter_node', '/planner_node'),
    ('/filter_node', '/mambo/driver'),
    ('/mambo/driver', '/mambo/guard'),
    ('/mambo/driver', '/turtlebot/driver'),
)
SIM = '/sim_node'
PAUSE = 3.0  # length of a pause [s]

_GRID = {'grid': [6, 6], 'spacing': 0.45, 'corner': [-0.1, -0.1]}
# One target is in view at the start, so that a result can be lost; the last one is far.
# Robots pass their waypoints.
_SEARCH = {
    'version': 1,
    'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
    'step': 0.05,
    'targets': {'positions': [[1.8, 1.8], [0.3, 0.3], [1.2, 2.2], [2.2, 0.2]]},
    'robots': {
        'mambo': {'type': 'mambo', 'start': [1.9, 1.9, 1.0], 'candidates': _GRID},
        'turtlebot': {'type': 'turtlebot3_burger', 'start': [0, 0, 0], 'candidates': _GRID},
    },
    'filter': {
        'preset': 'paper_000',
        'particles': 2000,
        'found_radius': 0.02,
        'removal_distance': 0.05,
        'jitter_deviation': 0.003,
    },
    'planner': {'name': 'maasi', 'measurement': 'periodic'},
}
_MAVLINK = {
    'version': 1,
    'environment': {'bounds': [[0.0, 40.0], [0.0, 40.0]]},
    'step': 0.1,
    'targets': {'positions': [[6.0, 6.0], [30.0, 30.0], [36.0, 5.0], [5.0, 36.0]]},
    'robots': {
        'drone': {
            'type': 'mavlink_drone',
            'link': 'mavlink',
            'start': [4.0, 4.0, 3.0],
            'candidates': {'grid': [4, 4], 'spacing': 10.0, 'corner': [5.0, 5.0]},
            'mavlink': {'arm': True},
        }
    },
    # The other filter may give up a found target, without any fault.
    'filter': {'method': 'ic_phd'},
    'planner': {'name': 'maasi', 'measurement': 'periodic'},
}
_BUILDINGS = {
    'version': 1,
    'environment': {'bounds': [[0.0, 300.0], [0.0, 300.0], [0.0, 80.0]]},
    'step': 1.0,
    'robots': {
        'red': {'type': 'search_drone', 'start': [160.0, 175.0, 5.0], 'hazard': {'failures': False}}
    },
    'planner': {
        'name': 'cuboid_mpc',
        'detection_probability': 1.0,
        'objects': [{'centre': [175.0, 130.0], 'size': [60.0, 60.0, 60.0]}],
    },
}


@dataclass(frozen=True)
class Case:
    """A run, and the fault of some of its nodes at the same time: kill, pause or hang."""

    fault: str
    nodes: tuple[str, ...]
    # Or 'start': as soon as the processes exist. 'middle': once a target is found, a cell visited.
    when: str = 'middle'
    lockstep: bool = False
    respawn: bool = False
    kind: str = 'search'

    @property
    def name(self):
        mode = 'lockstep' if self.lockstep else 'free'
        reaction = 'respawn' if self.respawn else 'end'
        nodes = '+'.join(node.strip('/').replace('/', '_') for node in self.nodes)
        return '-'.join((self.kind, mode, reaction, self.fault, self.when, nodes))

    @property
    def hangs_guards(self):
        """Whether guards alone hang, which robots do not wait for."""
        return self.fault == 'hang' and all(node.endswith('/guard') for node in self.nodes)

    @property
    def ends_the_run(self):
        """Whether exit code 3 is guaranteed; otherwise the run continues to its end, 0 or 1."""
        if self.fault == 'pause':
            return False
        # A restarted simulation would begin at time 0; a start that hangs is not repeated.
        if not self.respawn or SIM in self.nodes:
            return True
        if self.hangs_guards:
            return False
        return self.fault == 'hang' and (self.lockstep or self.when == 'start')

    def scenario(self):
        limits = {'silence': 8.0, 'start': 120.0, 'time': 12.0}
        if self.fault == 'hang' and self.when == 'start':
            limits['start'] = 30.0
        if not self.ends_the_run and not self.lockstep:
            # Long enough for a restart on a busy machine.
            limits['time'] = 16.0 if self.fault == 'pause' else 20.0
        if self.kind != 'search':
            limits['time'] *= 3.0
        if self.name.endswith('-hang-middle-filter_node') and not self.lockstep:
            # Late, so that the robots have to stand before the run ends or restarts the filter.
            limits['heartbeat'] = 9.0 if self.kind == 'search' else 14.0
        content = {'search': _SEARCH, 'mavlink': _MAVLINK, 'buildings': _BUILDINGS}[self.kind]
        if self.kind == 'mavlink':
            # Each run has its own port.
            drone = content['robots']['drone']
            link = drone['mavlink'] | {'url': f'udpin:127.0.0.1:{free_port()}'}
            content = {**content, 'robots': {'drone': {**drone, 'mavlink': link}}}
        return {
            **content,
            'stop': 'all_found',
            'on_exit': 'respawn' if self.respawn else 'end',
            'limits': limits,
        }

    def options(self):
        if self.lockstep:
            return ['--lockstep']
        return ['--rate', '3'] if self.kind == 'buildings' else []


def _cases(faults, struck, modes='free lockstep', respawn=(True, False), **more):
    """Return the cases of faults and nodes in modes; there are no guards in lockstep."""
    return [
        Case(fault, nodes, lockstep=mode == 'lockstep', respawn=reaction, **more)
        for fault in faults.split()
        for mode in modes.split()
        for reaction in respawn
        for nodes in struck
        if mode == 'free' or not any(node.endswith('/guard') for node in nodes)
    ]


def all_cases():
    """Return the whole campaign; the most important cases come first."""
    one, vehicles, buildings = (
        [(node,) for node in nodes] for nodes in (SEARCH_NODES, MAVLINK_NODES, BUILDING_NODES)
    )
    end = {'respawn': (False,)}
    return [
        *_cases('kill hang', one),
        *_cases('pause', one, **end),
        *_cases('kill', _PAIRS),
        *_cases('kill', one, when='start'),
        *_cases('kill hang', buildings, kind='buildings'),
        *_cases('pause', buildings, kind='buildings', **end),
        *_cases('kill hang', vehicles, 'free', kind='mavlink'),
        *_cases('pause', vehicles, 'free', kind='mavlink', **end),
        *_cases('hang pause', _PAIRS, **end),
        *_cases('hang pause', one, when='start', **end),
    ]
