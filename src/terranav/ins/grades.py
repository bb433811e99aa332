"""Named grades of inertial navigation systems, with their figures and where they come from.

Sensor figures, as quoted from the makers' data sheets in the IMU models of NavToolkit (IS4S, `ImuModel.hpp`,
functions hg9900_model, hg1700_model and stim300_model), all 1-sigma:

============  =================  ================  ==========================  =========  ======================
grade         IMU                gyro bias         angular random walk         accel bias velocity random walk
============  =================  ================  ==========================  =========  ======================
navigation    Honeywell HG9900   0.0035 deg/h      0.002 deg/sqrt(h)           25 ug      none listed: 0
tactical      Honeywell HG1700   1 deg/h           0.125 deg/sqrt(h)           1 mg       0.0198 m/s/sqrt(h)
industrial    Sensonor STIM300   10 deg/h          0.15 deg/sqrt(h)            2 mg       0.06 m/s/sqrt(h)
============  =================  ================  ==========================  =========  ======================

The HG1700's velocity random walk is listed as 0.065 ft/s/sqrt(h). The industrial MEMS unit is taken without a thermal
calibration of one's own: the sheet's gyro bias under changing temperature (10 deg/h) and accelerometer bias over
temperature (2 mg), not its bias instability (0.5 deg/h, 0.05 mg).

The initial errors are no data-sheet figures; they follow from the sensors and from how such systems are aligned:

- tilt: levelling on the accelerometers leaves bias / g, 25 ug = 0.0014 deg, 1 mg = 0.057 deg, 2 mg = 0.11 deg;
- heading: gyrocompassing leaves gyro bias / (Earth rate cos(latitude)), 0.0035 deg/h = 0.02 deg at 45 degrees; the
  other two cannot gyrocompass and are given 1 deg and 2 deg, as after an alignment in motion;
- velocity: 0.1 m/s for a GNSS-aided start (0.05 to 0.1 m/s in the demonstrations that go with Groves, Principles of
  GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed.), 0.3 m/s for MEMS;
- position: how long ago the last fix was, so rather the scenario's than the grade's; here 200 m (papers/002), 500 m and
  1000 m. Override it with `dataclasses.replace`.

Levelling and then drawing tilt and accelerometer bias apart from one another counts the same error twice: in a levelled
system both cancel at first, and show once it turns. The grades keep to the worse of the two.

Two more are those of the papers, as tabled and nothing added (no tilt, no initial velocity error: neither is printed):

- paper_002: gyros 0.003 deg/h and 0.0015 deg/sqrt(h), accelerometers 25 ug and '5 ug/sqrt(hr)', read as 5 ug/sqrt(Hz)
  = 0.0029 m/s/sqrt(h), 200 m on each axis. The other reading, a velocity walk of 5 ug times an hour, 0.177
  m/s/sqrt(h), is run beside it by `terranav reproduce 002`.
- paper_003: gyros 0.1 deg/h and accelerometers 1e-4 g, both read as constant biases (1-sigma), 0.003 degrees on each
  axis, read as 0.003 degrees of latitude at 45 degrees, 333 m, both ways.
"""

from __future__ import annotations

from terranav.core.checks import unknown_name
from terranav.core.earth import GRAVITY_MPS2, metres_per_degree
from terranav.core.ins_grade import InsGrade

GRADES: dict[str, InsGrade] = {
    grade.name: grade
    for grade in (
        InsGrade(
            name="navigation",
            position_sigma_m=200.0,
            velocity_sigma_mps=0.1,
            position_walk_m_per_sqrt_s=0.0,
            attitude_sigma_deg=0.0014,
            heading_sigma_deg=0.02,
            gyro_bias_sigma_deg_per_h=0.0035,
            accel_bias_sigma_ug=25.0,
            gyro_walk_deg_per_sqrt_h=0.002,
            accel_walk_mps_per_sqrt_h=0.0,
        ),
        InsGrade(
            name="tactical",
            position_sigma_m=500.0,
            velocity_sigma_mps=0.1,
            position_walk_m_per_sqrt_s=0.0,
            attitude_sigma_deg=0.057,
            heading_sigma_deg=1.0,
            gyro_bias_sigma_deg_per_h=1.0,
            accel_bias_sigma_ug=1000.0,
            gyro_walk_deg_per_sqrt_h=0.125,
            accel_walk_mps_per_sqrt_h=0.0198,
        ),
        InsGrade(
            name="industrial",
            position_sigma_m=1000.0,
            velocity_sigma_mps=0.3,
            position_walk_m_per_sqrt_s=0.0,
            attitude_sigma_deg=0.11,
            heading_sigma_deg=2.0,
            gyro_bias_sigma_deg_per_h=10.0,
            accel_bias_sigma_ug=2000.0,
            gyro_walk_deg_per_sqrt_h=0.15,
            accel_walk_mps_per_sqrt_h=0.06,
        ),
        InsGrade(
            name="paper_002",
            position_sigma_m=200.0,
            velocity_sigma_mps=0.0,
            position_walk_m_per_sqrt_s=0.0,
            gyro_bias_sigma_deg_per_h=0.003,
            accel_bias_sigma_ug=25.0,
            gyro_walk_deg_per_sqrt_h=0.0015,
            accel_walk_mps_per_sqrt_h=5e-6 * GRAVITY_MPS2 * 60.0,
        ),
        InsGrade(
            name="paper_003",
            position_sigma_m=0.003 * float(metres_per_degree(45.0)[0]),
            velocity_sigma_mps=0.0,
            position_walk_m_per_sqrt_s=0.0,
            gyro_bias_sigma_deg_per_h=0.1,
            accel_bias_sigma_ug=100.0,
        ),
    )
}


def grade_named(name: str) -> InsGrade:
    """Return the grade of this name.

    Parameters
    ----------
    name : str
        'navigation', 'tactical', 'industrial', 'paper_002' or 'paper_003'.

    Raises
    ------
    ConfigError
        For any other, offering the nearest.
    """
    if name not in GRADES:
        unknown_name("INS grade", name, GRADES)
    return GRADES[name]
