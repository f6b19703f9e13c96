"""A car's lateral motion by the single-track model: four states, three experiments.

The states are the lateral velocity v (m/s), the yaw rate w (rad/s), the heading and the lateral
position; the front wheels are steered by `steer` (rad) at the forward `speed` (m/s). A gyroscope
gives the yaw rate every 40 ms, a satellite receiver the position every 200 ms. Unknown are the
cornering stiffnesses of both axles, in 10^4 N/rad, and what is disturbed and measured with which
variance. The model: P. Riekert and T. E. Schunck, *Ingenieur-Archiv* 11 (1940), small angles.
"""

import ssmppl as ssm

DT = 0.04
MASS, INERTIA, FRONT, REAR = 1500.0, 2500.0, 1.2, 1.5  # kg, kg m^2; axles from the centre, m

vehicle = ssm.Model("single-track vehicle", inputs=("steer", "speed"))


@vehicle.prior
def prior():
    return {
        "c_front": ssm.Normal(6, sd=3),
        "c_rear": ssm.Normal(6, sd=3),
        "q_v": ssm.InverseGamma(3, scale=1e-3),
        "q_w": ssm.InverseGamma(3, scale=5e-5),
        "r_gyro": ssm.InverseGamma(3, scale=1e-3),
        "r_position": ssm.InverseGamma(3, scale=1e-1),
    }


@vehicle.initial
def initial():
    return {
        "v": ssm.Normal(0, sd=0.1),
        "w": ssm.Normal(0, sd=0.02),
        "heading": ssm.Normal(0, sd=0.02),
        "position": ssm.Normal(0, sd=0.5),
    }


@vehicle.transition
def transition(v, w, heading, position, steer, speed, c_front, c_rear, q_v, q_w):
    force_front = 1e4 * c_front * (steer - (v + FRONT * w) / speed)
    force_rear = 1e4 * c_rear * (-(v - REAR * w) / speed)
    return {
        "v": ssm.Normal(v + DT * ((force_front + force_rear) / MASS - speed * w), variance=q_v),
        "w": ssm.Normal(w + DT * (FRONT * force_front - REAR * force_rear) / INERTIA, variance=q_w),
        "heading": ssm.Dirac(heading + DT * w),
        "position": ssm.Dirac(position + DT * (v + speed * heading)),
    }


@vehicle.observation
def observation(w, position, r_gyro, r_position):
    return {
        "gyro": ssm.Normal(w, variance=r_gyro),
        "place": ssm.Normal(position, variance=r_position),
    }
