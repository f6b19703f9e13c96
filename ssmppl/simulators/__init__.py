"""Ready adapters: simulators of others as `ssm.simulator` objects, each an optional extra.

`mujoco` takes MuJoCo models (pip install 'ssmppl[mujoco]'), `fmu` functional mock-up units
(pip install 'ssmppl[fmu]'). The packages are imported when one of these is first called.
"""

from ssmppl.simulators.fmu_file import fmu
from ssmppl.simulators.mujoco_model import mujoco

__all__ = ["fmu", "mujoco"]
