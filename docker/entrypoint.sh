#!/bin/bash
# The shell's environment of ROS and of the workspace, then the command.
set -e
source /opt/ros/jazzy/setup.bash
source /opt/active6d/install/setup.bash
exec "$@"
