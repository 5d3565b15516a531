"""Motion models: one closed loop for prediction, driver and simulator, and its limits."""

import math

import numpy as np
import pytest
import scipy.linalg

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_planner import MotionSettings, RobotState, make_motion
from maasi_planner.motion.mambo import GRAVITY, INERTIA, MASS, PERIOD, lqr_gains, mambo_parameters

MODELS = {
    'constant_speed': MotionSettings(model='constant_speed', speed=0.5, acceleration=0.8),
    'constant_speed_free': MotionSettings(model='constant_speed', speed=0.5),
    'mambo': MotionSettings(model='mambo', speed=0.4, approach_rate=1.2),
    'mambo_travel': MotionSettings(model='mambo', speed=0.4, heading='travel'),
    'unicycle': MotionSettings(
        model='unicycle',
        speed=0.22,
        yaw_rate=2.84,
        acceleration=2.5,
        yaw_acceleration=6.0,
        tolerance=0.04,
    ),
    'quadrotor': MotionSettings(model='quadrotor', speed=0.5),
}


def test_lqr_is_that_of_the_whole_model():
    settings = MotionSettings(
        model='mambo',
        state_weights=[2, 3, 4, 1, 5, 1, 1, 2, 1, 1, 1, 3],
        input_weights=[900, 1000, 700, 100],
    )
    a = np.zeros((12, 12))
    b = np.zeros((12, 4))
    a[0, 6] = a[1, 7] = a[2, 8] = 1.0
    a[3, 9] = a[4, 10] = a[5, 11] = 1.0
    a[6, 4], a[7, 3] = GRAVITY, -GRAVITY
    b[9, 0], b[10, 1], b[11, 2] = (1.0 / value for value in INERTIA)
    b[8, 3] = 1.0 / MASS
    both = scipy.linalg.expm(np.block([[a, b], [np.zeros((4, 16))]]) * PERIOD)
    discrete_a, discrete_b = both[:12, :12], both[:12, 12:]
    q = np.diag(settings.state_weights)
    r = np.diag(settings.input_weights)
    p = scipy.linalg.solve_discrete_are(discrete_a, discrete_b, q, r)
    gain = np.linalg.solve(r + discrete_b.T @ p @ discrete_b, discrete_b.T @ p @ discrete_a)
    own = lqr_gains(settings)
    assert own['roll'] == pytest.approx(gain[0, [1, 7, 3, 9]], rel=1e-6)
    assert own['pitch'] == pytest.approx(gain[1, [0, 6, 4, 10]], rel=1e-6)
    assert own['yaw'] == pytest.approx(gain[2, [5, 11]], rel=1e-6)
    assert own['height'] == pytest.approx(gain[3, [2, 8]], rel=1e-6)


def test_command_is_the_leading_set_point():
    """Near the waypoint the velocity command is the LQR's own set-point there."""
    settings = MotionSettings(model='mambo', speed=4.0)
    motion = make_motion(settings)
    gains = lqr_gains(settings)
    waypoint = np.array([0.5, 0.0, 0.0])
    command = motion.command(RobotState.at_rest([0.0, 0.0, 0.0]), waypoint)
    torque = mambo_parameters(settings)[0] * command[0]
    assert torque == pytest.approx(gains['pitch'][0] * 0.5, rel=0.05)


@pytest.mark.parametrize('name', MODELS)
def test_simulated_is_predicted(name):
    motion = make_motion(MODELS[name])
    rng = np.random.default_rng(3)
    state = RobotState.at_rest([1.0, 0.5, 1.0], 0.4)
    goals = rng.uniform(-0.3, 2.4, size=(4, 3))
    if name == 'unicycle':
        goals[:, 2] = 1.0
    prediction = motion.predict(state, goals, 0.05)
    assert prediction.reached.all()
    for w, goal in enumerate(goals):
        body = motion.body(state)
        length = int(prediction.lengths[w])
        for k in range(length + 1):
            now = body.robot_state()
            assert now.pose.position == pytest.approx(prediction.positions[w, k], abs=1e-9)
            turn = math.remainder(now.pose.yaw - prediction.yaws[w, k], 2 * math.pi)
            assert abs(turn) < 1e-9
            assert motion.arrived(now.pose.position, goal) == (k == length)
            body.step(motion.command(now, goal), 0.05)
        # Afterwards the trajectory stays where it is.
        assert (prediction.positions[w, length:] == prediction.positions[w, length]).all()


@pytest.mark.parametrize('name', MODELS)
def test_every_waypoint_is_reached(name):
    settings = MODELS[name]
    motion = make_motion(settings)
    axis = np.linspace(-0.3, 2.4, 8)
    height = 0.0 if settings.model == 'unicycle' else 1.0
    goals = np.array([[x, y, height] for x in axis for y in axis])
    rng = np.random.default_rng(7)
    for _ in range(6):
        start = np.append(rng.uniform(-0.3, 2.4, 2), height)
        prediction = motion.predict(
            RobotState.at_rest(start, float(rng.uniform(-math.pi, math.pi))), goals, 0.05
        )
        assert prediction.reached.all()
        rows = np.arange(len(goals))
        ends = prediction.positions[rows, prediction.lengths]
        gaps = np.sqrt(((ends - goals) ** 2).sum(axis=1))
        assert gaps.max() <= settings.tolerance + 1e-12


FAST = {
    f'{model}_{tilt}': MotionSettings(model=model, speed=4.0, tilt=tilt, acceleration=3.0)
    for model in ('mambo', 'quadrotor')
    for tilt in (0.1, 0.4)
}


@pytest.mark.parametrize('settings', [*MODELS.values(), *FAST.values()], ids=[*MODELS, *FAST])
def test_limits_hold_under_any_command(settings):
    body = make_motion(settings).body(RobotState.at_rest([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(11)
    fast = settings.speed > 1.0
    exact = settings.model == 'constant_speed'
    for k in range(2000):
        if k % 40 == 0 and fast:
            command = np.append(rng.choice([-4.0, 4.0], size=2), [rng.normal(), 0.0])
        elif k % 12 == 0 and not fast:
            command = rng.normal(size=4) * [1.5, 1.5, 1.0, 6.0]
        before = body.robot_state().velocity
        body.step(command, 0.05)
        now = body.robot_state()
        assert np.linalg.norm(now.velocity) <= settings.speed * (1.001 if fast else 1.0 + 1e-9)
        assert abs(now.angular_velocity[2]) <= settings.yaw_rate * (1.0 + 1e-6)
        tilts = np.arcsin(now.pose.rotation()[2, :2])
        assert np.abs(tilts).max() <= settings.tilt * 1.02
        if settings.acceleration is not None and settings.model != 'unicycle':
            change = now.velocity - before
            size = np.linalg.norm(change) if exact else np.abs(change).max()
            assert size / 0.05 <= settings.acceleration * (1.0 + 1e-9 if exact else 1.001)


@pytest.mark.parametrize(('heading', 'yaw'), [('keep', -2.0), ('travel', math.pi / 4)])
def test_drone_keeps_its_height_and_heading_or_faces_its_travel(heading, yaw):
    motion = make_motion(MotionSettings(model='mambo', speed=0.4, heading=heading))
    state = RobotState.at_rest([0.0, 0.0, 1.0], -2.0)
    prediction = motion.predict(state, [[2.0, 2.0, 1.0]], 0.05)
    assert np.abs(prediction.positions[0, :, 2] - 1.0).max() < 1e-12
    assert prediction.yaws[0, prediction.lengths[0]] == pytest.approx(yaw, abs=0.05)


def test_control_cost_counts_what_it_says():
    """A climb costs force, level flight torques; `torques` leaves the force out."""
    state = RobotState.at_rest([0.0, 0.0, 1.0])
    up, along = [[0.0, 0.0, 2.0]], [[1.0, 0.0, 1.0]]
    every = make_motion(MotionSettings(model='mambo'))
    torques = make_motion(MotionSettings(model='mambo', control_inputs='torques'))
    assert every.predict(state, up, 0.05).control_cost[0] > 0.0
    assert torques.predict(state, up, 0.05).control_cost[0] < 1e-20
    assert every.predict(state, along, 0.05).control_cost[0] == pytest.approx(
        torques.predict(state, along, 0.05).control_cost[0], rel=1e-6
    )


def among(*rows):
    """Return an area with round obstacles: x, y, radius, or x, y, z, radius of a sphere."""
    zones = [{'centre': list(row[:-1]), 'radius': row[-1]} for row in rows]
    bounds = [[-1e3, 1e3]] * 3
    return Area(EnvironmentSettings.model_validate({'bounds': bounds, 'obstacles': zones}))


@pytest.mark.parametrize('kind', ['printed', 'away'])
def test_obstacle_term_of_the_paper(kind):
    """(14), (15): nothing beyond d_l; within it k_obs off the inputs, or along the way out."""
    obstacles = among([1.0, 0.0, 0.2])
    common = {'model': 'mambo', 'obstacle_distance': 0.12, 'obstacle_gain': 0.002}
    term = make_motion(MotionSettings(**common, obstacle_term=kind, clearance=1e-6), obstacles)
    plain = make_motion(MotionSettings(**common))
    gains = mambo_parameters(term.settings)
    goal = [0.0, 3.0, 1.0]
    far, near = RobotState.at_rest([0.6, 0.0, 1.0]), RobotState.at_rest([0.75, 0.0, 1.0])
    assert (term.command(far, goal) == plain.command(far, goal)).all()
    change = term.command(near, goal) - plain.command(near, goal)
    # Roll, which accelerates to the right, has a gain of the other sign.
    inputs = change * gains[[0, 3, 6, 7]]
    expected = [-0.002] * 4 if kind == 'printed' else [-0.002, 0.0, 0.0, 0.0]
    assert inputs == pytest.approx(expected, abs=1e-12)


UNICYCLE = {'model': 'unicycle', 'speed': 0.2, 'obstacle_distance': 0.12, 'obstacle_gain': 0.3}


@pytest.mark.parametrize(
    ('kind', 'change'), [('printed', [-0.3, 0.0, 0.0, -0.3]), ('away', [0.0, 0.0, 0.0, 0.3])]
)
def test_obstacle_term_of_a_ground_robot(kind, change):
    """It acts on forward speed and turn rate: an obstacle to the right turns it to the left."""
    disc = among([1.0, -0.3, 0.2])
    term = make_motion(MotionSettings(**UNICYCLE, obstacle_term=kind), disc)
    goal, near = [3.0, 0.0, 0.0], RobotState.at_rest([1.0, 0.0, 0.0])
    plain = make_motion(MotionSettings(**UNICYCLE))
    assert term.command(near, goal) - plain.command(near, goal) == pytest.approx(change)


def test_ground_robot_keeps_away_by_the_obstacle_term():
    """It gets by a disc with more room than without the term, or stays before the disc."""
    start, goal = RobotState.at_rest([0.0, 0.0, 0.0]), [[2.0, 0.0, 0.0]]
    for side, gets_by, gain in ((-0.21, True, 0.01), (-0.05, False, 0.2)):
        disc = among([1.0, side, 0.15])
        term = make_motion(MotionSettings(**UNICYCLE, obstacle_term='away'), disc)
        plain = make_motion(MotionSettings(**UNICYCLE))
        room = {}
        for name, motion in (('term', term), ('plain', plain)):
            prediction = motion.predict(start, goal, 0.05)
            assert prediction.reached[0] == (name == 'plain' or gets_by)
            room[name] = min(disc.distances(place)[0] for place in prediction.positions[0])
        assert room['term'] > max(0.0, room['plain'] + gain)


@pytest.mark.parametrize('model', ['constant_speed', 'quadrotor'])
def test_obstacle_term_pushes_away_in_every_model(model):
    sphere = among([0.0, 0.3, 1.0, 0.2])
    settings = {'model': model, 'obstacle_distance': 0.12, 'obstacle_gain': 0.1}
    near, goal = RobotState.at_rest([0.0, 0.0, 1.0]), [3.0, 0.0, 1.0]
    term = make_motion(MotionSettings(**settings, obstacle_term='away'), sphere)
    change = term.command(near, goal) - make_motion(MotionSettings(**settings)).command(near, goal)
    assert change[1] < -1e-3
    assert change[[0, 2, 3]] == pytest.approx(0.0, abs=1e-12)


REST = RobotState.at_rest([0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ('make', 'words'),
    [
        (lambda motion: RobotState(REST.pose, np.array([0.0, np.nan, 0.0])), 'velocity'),
        (lambda motion: motion.predict(REST, [[0.0, np.inf, 0.0]], 0.05), 'waypoints'),
        (lambda motion: motion.predict(REST, [[0.0, 1.0]], 0.05), 'waypoints'),
        (lambda motion: motion.body(REST).step([0.0, 0.0, np.nan, 0.0], 0.05), 'command'),
        (lambda motion: motion.body(REST).step([0.0, 0.0, 0.0, 0.0], 0.0), 'step'),
        (lambda motion: MotionSettings(speed=-1.0), 'speed'),
        (
            lambda motion: MotionSettings(obstacle_term='away', avoidance='dynamic_window'),
            'avoidance: got dynamic_window',
        ),
        (lambda motion: MotionSettings(speed=math.inf), 'finite'),
    ],
)
def test_bad_states_and_commands_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make(make_motion(MODELS['mambo']))
