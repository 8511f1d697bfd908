"""MJCF files that are composed: nested classes and frames, copies, attached files with settings of their own.

MuJoCo compiles the same files; ``mjcf_misreadings`` compares forces, limits, loops, contacts and more.
"""

import mujoco
import pytest

from support.mjcf_misreadings import misreadings

TOOL = """<mujoco model="tool">
 <compiler angle="radian" eulerseq="zyx" autolimits="false"/>
 <default><joint damping="0.4" armature="0.02"/><default class="fine">
   <joint damping="0.05" range="-0.3 0.4" limited="true"/><geom density="300"/></default></default>
 <worldbody>
  <body name="wrist" pos="0 0 .1" euler="0.3 -0.2 0.5">
    <joint name="wr" axis="0 0 1" range="-1 1" limited="false"/><geom type="box" size=".04 .03 .05"/>
    <body name="finger" pos="0 .03 .05" childclass="fine"><joint name="f" type="slide" axis="0 1 0"/>
      <geom type="capsule" size=".01" fromto="0 0 0 0 0 .08"/><site name="tip" pos="0 0 .08" euler=".2 .4 .1"/>
      </body>
  </body>
 </worldbody>
 <actuator><position name="pinch" joint="f" kp="80" dampratio="1" ctrlrange="-.3 .4" ctrllimited="true"/>
   </actuator>
</mujoco>
"""
ATTACHED = """<mujoco model="a1">
 <compiler angle="degree" eulerseq="XYZ" autolimits="true" boundmass="0.01" boundinertia="1e-5"/>
 <option gravity="0.5 -0.3 -9.6" timestep="0.004"/>
 <asset><model name="tool" file="tool.xml"/></asset>
 <default>
  <joint damping="1" armature="0.05" stiffness="2"/>
  <default class="arm"><joint axis="0 1 0" springref="20" range="-90 120"/>
    <geom type="capsule" size=".03" density="700"/>
   <default class="elbow"><joint ref="15" solreflimit="0.03 0.7" frictionloss="0.3" damping="0.2"/></default>
     </default>
 </default>
 <worldbody>
  <geom name="floor" type="plane" size="9 9 1" pos="0 0 50"/>
  <frame name="fr" pos=".1 .2 .3" euler="10 20 30" childclass="arm">
   <frame pos="0 0 .1" axisangle="0 0 1 40">
    <body name="base" pos="0 0 .05"><freejoint name="root"/><geom type="box" size=".1 .1 .05" class="arm"/>
     <body name="upper" pos="0 0 .1"><joint name="sh"/>
       <joint name="sh2" axis="1 0 0" pos=".01 .02 0" range="-30 40"/><geom fromto="0 0 0 .3 0 0"/>
      <body name="lower" pos=".3 0 0" euler="0 30 0"><joint name="el" class="elbow"/>
        <geom fromto="0 0 0 .25 0 0"/>
        <frame pos=".25 0 0" quat="0.9 0.1 0.2 0.3"><attach model="tool" body="wrist" prefix="t_"/></frame>
      </body></body>
    </body>
   </frame>
  </frame>
  <replicate count="3" offset="0 1 0" euler="0 0 20" sep="_r"><body name="pend" pos="1 0 1">
    <joint name="p" axis="0 1 1" range="-50 60"/><geom type="cylinder" size=".02 .1" pos="0 0 -.1"/>
    <site name="ps"/></body></replicate>
 </worldbody>
 <tendon><fixed name="mix"><joint joint="sh" coef="2"/><joint joint="el" coef="-.5"/></fixed><fixed name="one">
   <joint joint="t_wr" coef="3"/></fixed><fixed name="elt"><joint joint="el" coef="-2"/></fixed></tendon>
 <equality><joint name="cpl" joint1="sh2" joint2="sh" polycoef=".1 .5 0 0 0"/>
   <tendon name="tcpl" tendon1="elt" tendon2="one" polycoef="0.2 1 0 0 0"/></equality>
 <actuator>
   <general name="g" joint="el" gear="3" gainprm="5" biastype="affine" biasprm=".2 -7 -.3" ctrlrange="-1 2"
   forcerange="-4 6"/><motor name="m" tendon="mix" gear="2" ctrlrange="-1 1"/>
   <velocity name="v" joint="sh" kv="3" gear="-2"/><position name="p" joint="p_r0" kp="7" inheritrange="1"/>
   <motor name="jp" jointinparent="t_wr" gear="1.5"/></actuator>
 <keyframe><key name="k" qpos="0 0 1 1 0 0 0 .1 .2 .3 .1 .05 .1 .2 .3" ctrl="1 2 3 .1 .2 .3"/></keyframe>
</mujoco>
"""
COPIED = """<mujoco model="a4">
 <compiler angle="radian" eulerseq="XzY"/>
 <option gravity="0 0 -9.81"><flag damper="disable" limit="enable"/></option>
 <default>
  <joint range="-.5 .6"/>
  <default class="one">
    <general gear="2 0 0 0 0 0" ctrlrange="-1 1" biastype="affine" gainprm="3" biasprm="0 -3 -1"/>
    <joint damping=".5" frictionloss=".2"/>
    <default class="two"><joint damping=".7" axis="0 1 0" range="0 0"/><general gear="-4"/>
      <site size=".01" pos="0 0 .1" euler=".1 .2 .3"/></default></default>
  <default class="three"><joint type="slide" stiffness="5" range="-.2 .3" springref=".1"/></default>
 </default>
 <worldbody>
  <geom name="floor" type="plane" size="9 9 1" pos="0 0 50"/>
  <body name="r" pos="0 0 1" childclass="one"><joint name="a"/><geom size=".1" pos=".2 0 0"/>
   <frame childclass="two" euler=".3 .4 .5"><body name="s" pos=".4 0 0"><joint name="b"/>
     <joint name="b2" class="three" axis="1 1 0"/><geom size=".05 .05 .05" type="box" euler=".1 .2 .3"/>
     <site name="s0"/>
     <replicate count="2" offset="0 .1 0" sep="-"><replicate count="2" offset=".1 0 0" euler="0 0 .2" sep="+">
       <body name="k"><joint name="kj" class="three"/><geom type="capsule" size=".01 .02" pos=".1 0 0"/></body>
       </replicate></replicate>
   </body></frame></body>
 </worldbody>
 <actuator><general name="ga" class="two" joint="b"/>
   <general name="gb" class="one" joint="a" forcerange="-2 2"/>
   <position name="pp" inheritrange=".8" class="three" joint="b2"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("text", [ATTACHED, COPIED], ids=["attached", "copied"])
def test_composed_files_are_mujocos(text, tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(text)
    (tmp_path / "tool.xml").write_text(TOOL)
    model = mujoco.MjModel.from_xml_path(str(file))
    wrong, said = misreadings(file, model)
    assert wrong == [] and "contacts of" in said
