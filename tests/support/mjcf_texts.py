"""MJCF of a floating body with an arm, and parts to put into it: loops, couplings, actuators, keyframes."""

EXACT = 1e-12  # relative; rounding leaves 2e-15, times the condition number (below 2000) in accelerations 2e-14
FREE = """<mujoco><option gravity="1 2 -9"/><default><joint armature=".3" damping=".2" stiffness="4"/></default>
 <worldbody><body name="root" pos="1 2 3" quat=".5 .1 -.7 .2"><joint name="root" type="free"/>{root}<geom type="box"
  size=".1 .2 .3" pos=".1 .2 .05"/><body name="arm" pos="0 0 .4"><joint name="a" axis="1 1 0"/><geom type="capsule"
  size=".05" fromto="0 0 0 .2 .1 .3"/></body></body>{world}</worldbody>{more}</mujoco>"""

EMPTY = {"root": "", "world": "", "more": ""}

TIES = """<body name="x" pos=".3 .1 0"><joint name="x" axis="0 1 0" pos=".1 0 0"/><geom size=".1"/>
  <site name="on_x" pos=".1 .2 .3" quat="1 .2 0 .1"/></body>
 <body name="y" pos=".1 .5 0"><joint name="y" axis="1 1 0" ref="20"/><geom size=".1"/>
  <site name="on_y" pos="0 .1 .1"/></body>
 <body name="m" mocap="true" pos="1 1 1"><geom size=".1"/></body><site name="on_world" pos="2 0 0"/>"""

EQUALITY = """<equality><connect name="c" body1="x" body2="root" anchor=".1 .2 .3"/><connect body1="y" anchor="0 .1 0"/>
 <weld name="w" body1="arm" body2="x" relpose=".1 .2 .3 .5 .1 .2 .3" anchor=".3 .2 .1"/>
 <weld name="to_mocap" body1="m" body2="y"/>
 <connect name="sites" site1="on_x" site2="on_y"/><weld name="frames" site1="on_world" site2="on_x"/>
 <weld name="turning" body1="arm" body2="y" torquescale="0"/><weld name="still" body1="m" body2="world"/>
 <joint name="slope" joint1="y" joint2="x" polycoef=".1 -2 0 0 0"/>
 <joint name="off" joint1="x" joint2="y" active="false"/>
 <tendon name="sum" tendon1="t" polycoef=".3 0 0 0 0"/>
 <tendon name="pair" tendon1="tx" tendon2="ty" polycoef=".3 2 0 0 0"/>
 </equality><tendon><fixed name="t"><joint joint="x" coef="2"/><joint joint="a" coef="-.5"/></fixed>
 <fixed name="tx"><joint joint="x" coef="2"/></fixed><fixed name="ty"><joint joint="y" coef="3"/></fixed></tendon>"""

ACTUATORS = """<actuator><motor name="motor" joint="a" gear="30" ctrllimited="true" ctrlrange="-1 .5"/>
 <position name="servo" joint="x" kp="30" kv="2" gear="5" forcelimited="true" forcerange="-20 40"/>
 <velocity name="speed" jointinparent="y" kv="3"/><general name="any" joint="x" gainprm="2" biastype="affine"
 biasprm="1 -2 -3" gear="-2"/><motor name="rope" tendon="t" gear="3"/>
 <motor name="off" joint="a" group="3"/></actuator>
 <tendon><fixed name="t"><joint joint="x" coef="2"/><joint joint="a" coef="-.5"/></fixed></tendon>"""

KEYS = """<keyframe><key name="home" qpos="1 2 3 .5 .5 -.5 .5 .7" qvel="1 2 3 4 5 6 7" ctrl=".2"/><key/></keyframe>
 <actuator><motor joint="a"/></actuator>"""
