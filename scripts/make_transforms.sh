#!/usr/bin/env bash
# Generates the Python messages of tf2_msgs, which PyPI lacks, and installs them into .venv, so that nodes take poses from
# /tf and publish them. With apt's ROS 2 they come with ros-jazzy-tf2-msgs. Needs cmake, g++ and Python's headers.
#   PREFIX  where to install instead of .venv
set -euo pipefail
cd "$(dirname "$0")/.."
prefix=${PREFIX:-$PWD/.venv}

fail() { printf 'transforms: %s\n' "$*" >&2; exit 1; }

for tool in cmake g++; do
    command -v "$tool" >/dev/null || fail "$tool is needed; on Debian or Ubuntu: apt-get install cmake g++"
done
headers=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("include"))')
[ -f "$headers/Python.h" ] || fail "Python's headers are needed; on Debian or Ubuntu: apt-get install python3-dev"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
.venv/bin/python -m venv "$work/venv"
# The generators go into an environment of their own, in the versions of the messages in .venv.
.venv/bin/pip freeze | grep -E '^(ros-|numpy)' >"$work/versions.txt"
generators="adapter cli cmake core-generators core-runtime default-generators default-runtime generator-c generator-cpp
    generator-py generator-type-description typesupport-c typesupport-cpp typesupport-fastrtps-c
    typesupport-fastrtps-cpp typesupport-introspection-c typesupport-introspection-cpp"
ament="core export-definitions export-dependencies export-include-directories export-interfaces export-libraries
    export-link-flags export-targets gen-version-h gmock gtest include-directories libraries pytest python ros
    target-dependencies test version"
# shellcheck disable=SC2046  # words on purpose
"$work/venv/bin/pip" install -qq -c "$work/versions.txt" setuptools numpy 'empy<4' lark catkin_pkg ros-jazzy-geometry-msgs \
    ros-jazzy-ament-package ros-jazzy-ament-cmake ros-jazzy-python-cmake-module ros-jazzy-fastrtps-cmake-module \
    ros-jazzy-gtest-vendor ros-jazzy-gmock-vendor ros-jazzy-domain-coordinator \
    $(printf 'ros-jazzy-rosidl-%s ' $generators) $(printf 'ros-jazzy-ament-cmake-%s ' $ament)

# The wheels name paths of the machine that built them.
arrays=$("$work/venv/bin/python" -c 'import numpy; print(numpy.get_include())')
grep -rlZ --include='*.cmake' /opt/python/ "$work/venv/share" | xargs -0 sed -i -E \
    -e "s#/opt/python/[^;\"]*/numpy/_?core/include#$arrays#g" -e "s#/opt/python/[^;\"]*/include/python3\.[0-9]+#$headers#g"

mkdir -p "$work/tf2_msgs/msg"
echo 'geometry_msgs/TransformStamped[] transforms' >"$work/tf2_msgs/msg/TFMessage.msg"
cat >"$work/tf2_msgs/package.xml" <<'XML'
<package format="3">
  <name>tf2_msgs</name><version>0.36.0</version><description>tf2_msgs</description>
  <maintainer email="active6d@example.org">active6d developers</maintainer><license>BSD-3-Clause</license>
  <buildtool_depend>ament_cmake</buildtool_depend><buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend><member_of_group>rosidl_interface_packages</member_of_group>
</package>
XML
cat >"$work/tf2_msgs/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.14)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
CMAKE
export PATH="$work/venv/bin:$PATH" AMENT_PREFIX_PATH="$work/venv" CMAKE_PREFIX_PATH="$work/venv" LD_LIBRARY_PATH="$work/venv/lib"
{
    cmake -S "$work/tf2_msgs" -B "$work/build" -DCMAKE_INSTALL_PREFIX="$prefix" -DCMAKE_BUILD_TYPE=Release \
        -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$work/venv/bin/python"
    cmake --build "$work/build"
    cmake --install "$work/build"
} >"$work/log" 2>&1 || { tail -30 "$work/log" >&2; fail "tf2_msgs could not be built"; }
echo "transforms: tf2_msgs is in $prefix"
