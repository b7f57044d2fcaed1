import sys, time, numpy as np
from stagectl.profile import load_profile
from sim_backend.machine import load_machine
from stagectl import trajectory
from tests.stage import followed, exact, with_values, rms, true_error_m, centre_m
from tests.effect_numbers import table
p=load_profile('oled-printer');m0=exact(load_machine('oled-printer'),p)
m0=with_values(m0,effects=p.effects,macro__force_noise_n=0.0,micro__force_noise_n=0.0,backlash__left_m=p.backlash.left_m,backlash__right_m=p.backlash.right_m,interferometer__clock_ppm=0.0)
mv=trajectory.trapezoid(0.05,0.1,dwell_s=0.3,lead_s=0.2).setpoints
c=centre_m(p)
def go(prof,mach,law):
    r=followed(prof,mach,law,mv)
    t=r.truth
    return r.commands.size==mv.size, 1e9*rms(true_error_m(r)), 1e9*rms(t['macro_position_m']-t['end_position_m']-c), 1e9*rms(r.measurements['end_position_m']-t['end_position_m'])
print('base',[go(p,m0,l) for l in('dsmc','pid')])
cases=[("dahl_friction","macro_force",{}),("lugre_friction","micro_force",dict(level_n=0.5)),("stribeck_friction","macro_force",{}),("coulomb_friction","micro_force",dict(level_n=0.5)),
("cable_hysteresis","macro_force",{}),("cable_hysteresis","micro_force",dict(level_n=1.0)),("load_dependent_friction","micro_force",{}),("cogging","micro_force",dict(amplitude_n=1.0)),
("mass_error","micro_force",dict(error_ratio=0.1)),("flexible_mode","micro_force",{}),("flexible_mode","macro_force",{}),
("current_ripple","micro_actuator",dict(ripple_ratio=0.05)),("force_constant_saturation","micro_actuator",dict(saturation_n=60.0)),("amplifier_dead_band","micro_command",{}),("amplifier_dead_band","macro_command",{}),
("current_loop_lag","micro_command",{}),("command_delay","micro_command",{}),("command_delay","macro_command",{}),
("sensor_delay","end_sensor",{}),("sensor_lag","end_sensor",{}),("sensor_lag","macro_sensor",{}),("cyclic_error","end_sensor",dict(first_m=50e-9)),("scale_error","end_sensor",dict(error_ppm=50.0)),("clock_skew","end_sensor",dict(skew_ppm=100.0)),("cubic_stiffness","joint",dict(stiffness_n_per_m3=1e13)),
("base_vibration","micro_force",{}),("gravity_tilt","micro_force",{})]
for name,place,v in cases:
    t0=time.time()
    e=table(name,place,**v)
    mach=with_values(m0,effects=(*m0.effects,e)); prof=with_values(p,effects=(*p.effects,e))
    for law in ('dsmc','pid'):
        a=go(p,mach,law); b=go(prof,mach,law)
        print(f"{name:26s} {place:14s} {law} unknown {a[0]:d} end {a[1]:9.1f} macro {a[2]:9.1f} meas {a[3]:9.1f} | known {b[0]:d} end {b[1]:9.1f} macro {b[2]:9.1f}", f"{time.time()-t0:.0f}s",flush=True)
