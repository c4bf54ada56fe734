"""A replay compares what the bag has, also when it is from a version with fewer columns."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from active6d_bringup.bags.replay import compare


def table(stamp=1, **columns):
    """A serialized table of float32 columns, four bytes each."""
    cloud = PointCloud2(height=1, width=2, point_step=4 * len(columns), row_step=8 * len(columns))
    cloud.header.stamp.sec = stamp
    cloud.fields = [
        PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
        for index, name in enumerate(columns)
    ]
    cloud.data = np.array(list(columns.values()), "<f4").T.tobytes()
    return serialize_message(cloud)


@pytest.mark.parametrize(
    ("live", "equal", "differences"),
    [
        (table(score=[0.25, 0.5], support=[1, 2]), True, {}),
        (table(score=[0.25, 0.5], support=[1, 2], entropy=[0, 1]), True, {}),
        (table(score=[0.25, 0.75], support=[1, 2], entropy=[0, 1]), False, {"score": 0.25}),
        (table(2, score=[0.25, 0.5], support=[1, 2], entropy=[0, 1]), False, {}),
        (table(score=[0.25, 0.5]), False, {"columns": pytest.approx(float("nan"), nan_ok=True)}),
    ],
    ids=["the same", "a column more", "another value", "another stamp", "a column less"],
)
def test_recorded_columns_are_compared(live, equal, differences):
    compared = compare(10**9, "objects", table(score=[0.25, 0.5], support=[1, 2]), live)
    assert (compared.equal, compared.differences) == (equal, differences)
