# The trainer with its environment, set up and compiled: `docker build -t cutting-trainer .`, then
# `docker run --rm -it --cap-add SYS_NICE --ulimit rtprio=98 cutting-trainer` runs the demo.
FROM ros:jazzy-ros-base
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        build-essential cmake python3-dev python3-venv ros-jazzy-rmw-fastrtps-cpp \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/cutting_trainer
COPY . .
RUN . /opt/ros/jazzy/setup.sh && ./trainer setup
CMD ["demo"]
ENTRYPOINT ["/ros_entrypoint.sh", "./trainer"]
