# The suite in a ROS 2 workspace, as in docs/install.md, built and tested:
#   docker build -t maasi . && docker run --rm maasi ros2 run maasi_sim run_scenario mambo_turtlebot --lockstep
FROM ros:jazzy AS dependencies
SHELL ["/bin/bash", "-c"]
WORKDIR /maasi
# As if the virtual environment were active.
ENV VIRTUAL_ENV=/maasi/venv PATH=/maasi/venv/bin:$PATH
# Only what names the dependencies, so that an edit of anything else does not install them again.
COPY requirements.txt src/
COPY config/package.xml src/config/
COPY maasi_drivers/package.xml src/maasi_drivers/
COPY maasi_filter/package.xml src/maasi_filter/
COPY maasi_msgs/package.xml src/maasi_msgs/
COPY maasi_planner/package.xml src/maasi_planner/
COPY maasi_sim/package.xml src/maasi_sim/
RUN apt-get update \
    && rosdep update --rosdistro jazzy \
    && apt-get install -y --no-install-recommends python3-venv \
    && rosdep install --from-paths src --ignore-src --rosdistro jazzy -y \
    && rm -rf /var/lib/apt/lists/*
RUN /usr/bin/python3 -m venv --system-site-packages venv \
    && touch venv/COLCON_IGNORE \
    && pip install --no-cache-dir -r src/requirements.txt 'numpy<2'

FROM dependencies AS suite
ENV NUMBA_CACHE_DIR=/maasi/numba
COPY . src/
RUN source /opt/ros/jazzy/setup.bash \
    && python3 -m colcon build \
    && source install/setup.bash \
    && python3 src/scripts/compile_kernels.py
RUN source install/setup.bash \
    && python3 -m colcon test --event-handlers console_direct+ --return-code-on-test-failure \
    && python3 -m colcon test-result --verbose
ENTRYPOINT ["/bin/bash", "-c", "source /maasi/install/setup.bash && exec \"$@\"", "--"]
CMD ["ros2", "launch", "maasi_sim", "scenario.launch.py", "--show-args"]
