"""Write `pyarrow.parquet`: a log as pandas or pyarrow users store one, with every accepted column type.

Run with `python pyarrow.py` beside pyarrow 26; the tests read the result.
"""

import sys

sys.path.pop(0)  # This file's own name would hide the library.

import pyarrow as pa
import pyarrow.parquet as pq

table = pa.table(
    {
        "t": pa.array([0.0, 0.005, 0.01, 0.015], pa.float64()),
        "segment": pa.array([0, 0, 0, 0], pa.uint32()),
        "episode": pa.array([0, 0, 1, 1], pa.int64()),
        "kp": pa.array([20, 20, 20, 20], pa.int32()),
        "kd": pa.array([0.5, 0.5, 0.5, 0.5], pa.float32()),
        "q_FL_hip": pa.array([0.1, 0.2, 0.3, 0.4], pa.float64()),
        "q_cmd_FL_hip": pa.array([0.15, 0.25, 0.35, 0.45], pa.float64()),
        "temp_FL_hip": pa.array([31, None, None, 32], pa.int8()),
        "contact_FL": pa.array([True, False, None, True], pa.bool_()),
        "battery_V": pa.array([28.5, None, 28.25, 28.0], pa.float32()),
        "note": pa.array(["a", "b", None, "d"], pa.string()),
        "raw": pa.array([[1, 2], [], None, [3]], pa.list_(pa.int32())),
    }
)
pq.write_table(table, "pyarrow.parquet", compression="snappy", row_group_size=3)
