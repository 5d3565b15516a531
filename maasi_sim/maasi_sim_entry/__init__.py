"""Console scripts of maasi_sim."""

from functools import partial

from maasi_filter_entry import run

cuboid_sim_node = partial(run, 'maasi_sim.run.buildings.cuboid_sim_node:CuboidSimNode')
sim_node = partial(run, 'maasi_sim.simulation.sim_node:SimNode')
fake_mambo = partial(run, 'maasi_sim.simulation.emulators.mambo.fake_mambo:main', ros=False)
fake_mavlink_vehicle = partial(
    run, 'maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle:main', ros=False
)
view_node = partial(run, 'maasi_sim.run.view.view_node:main')
compare = partial(run, 'maasi_sim.experiments.compare:main', ros=False)
run_scenario = partial(run, 'maasi_sim.run.run_scenario:main', ros=False)  # it looks itself
