# ruff: noqa: E501  A variant of a file is one line.
"""Robot files are read as MuJoCo compiles them, or refused by the name of what is not supported."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from twinstep.server import find_program

mujoco = pytest.importorskip("mujoco")

BASE = """<mujoco model="mixed">
  <compiler angle="radian"/>
  <default>
    <joint armature="0.01" damping="0.1"/>
    <default class="heavy"><geom density="2000"/></default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <inertial pos="0.01 0.02 0.03" mass="5" diaginertia="0.05 0.06 0.07" quat="0.9 0.1 0.2 0.3"/>
      <geom type="box" size="0.2 0.1 0.05"/>
      <body name="upper" pos="0.2 0.1 0" quat="0.9 0.3 0.1 0.2">
        <joint name="shoulder" axis="0.3 0.5 -0.7" range="-1 2"/>
        <inertial pos="0 0 -0.1" mass="1" fullinertia="0.011 0.012 0.004 0.001 -0.002 0.0015"/>
        <geom name="bar" type="capsule" fromto="0 0 0 0 0.02 -0.2" size="0.02"/>
        <body name="lower" pos="0 0.02 -0.2">
          <joint name="elbow" axis="0 -1 0" range="-2 0.5" pos="0 0 0.01"/>
          <inertial pos="0 0 -0.1" mass="0.5" diaginertia="0.003 0.0031 0.0004"/>
          <geom type="sphere" pos="0 0 -0.2" size="0.03"/>
        </body>
      </body>
      <body name="rail" pos="-0.2 0 0">
        <joint name="slider" type="slide" axis="1 0 1" range="-0.1 0.2"/>
        <inertial pos="0 0 0" mass="0.7" diaginertia="0.002 0.002 0.003"/>
        <geom type="cylinder" size="0.03 0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" ctrlrange="-20 20"/>
    <motor name="elbow" joint="elbow" ctrlrange="-10 10"/>
    <motor name="slider" joint="slider" ctrlrange="-50 50"/>
  </actuator>
</mujoco>
"""

SHOULDER = 'joint name="shoulder" axis="0.3 0.5 -0.7" range="-1 2"'
MOTOR = '<motor name="shoulder" joint="shoulder" ctrlrange="-20 20"/>'
UPPER = 'name="upper" pos="0.2 0.1 0" quat="0.9 0.3 0.1 0.2"'
INERTIAL = '<inertial pos="0 0 -0.1" mass="0.5" diaginertia="0.003 0.0031 0.0004"/>'
RAIL = '<body name="rail" pos="-0.2 0 0">'


def change(*pairs: tuple[str, str]) -> str:
    text = BASE
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def joint(attributes: str) -> str:
    return change((SHOULDER, f"{SHOULDER} {attributes}"))


def motor(*elements: str) -> str:
    return change((MOTOR, "\n".join(elements)))


def compiler(attributes: str) -> str:
    return change(('angle="radian"', f'angle="radian" {attributes}'))


EQUAL = {
    "base": BASE,
    "degrees": change(('angle="radian"', 'angle="degree"')),
    "default of angle": change((' angle="radian"', "")),
    "limited false": joint('limited="false"'),
    "no range": change(('range="-1 2"', "")),
    "ref": joint('ref="0.7"'),
    "ref of a slide": change(('axis="1 0 1" range', 'ref="0.05" axis="1 0 1" range')),
    "spring": joint('stiffness="20" springref="0.3"'),
    "friction": joint('frictionloss="0.4"'),
    "axis of any length": change(("0.3 0.5 -0.7", "3 5 -7")),
    "default axis": change((' axis="0.3 0.5 -0.7"', "")),
    "hinge by name": joint('type="hinge"'),
    "two joints on a body": change(
        (f"<{SHOULDER}/>", f'<{SHOULDER}/><joint name="twist" axis="0 0 1" pos="0 0.1 0"/>')
    ),
    "solver settings": joint('solreflimit="0.01 1" margin="0.01"'),
    "euler": change((UPPER, 'name="upper" pos="0.2 0.1 0" euler="0.3 -0.5 0.9"')),
    "eulerseq": change(
        ('angle="radian"', 'angle="radian" eulerseq="ZyX"'), (UPPER, 'name="upper" euler="0.3 -0.5 0.9"')
    ),
    "axisangle": change((UPPER, 'name="upper" axisangle="1 2 3 0.7"')),
    "xyaxes": change((UPPER, 'name="upper" xyaxes="1 0.2 0 0.1 1 0.3"')),
    "zaxis": change((UPPER, 'name="upper" zaxis="0.3 0.4 -0.8"')),
    "zaxis down": change((UPPER, 'name="upper" zaxis="0 0 -1"')),
    "frame": change(
        (RAIL, f'<frame pos="0 0.1 0.2" euler="0.1 0.2 0.3">{RAIL}'),
        ("</body>\n    </body>\n  </worldbody>", "</body></frame>\n    </body>\n  </worldbody>"),
    ),
    "frame around a joint": change((f"<{SHOULDER}/>", f'<frame pos="0.1 0 0" euler="0 0 0.5"><{SHOULDER}/></frame>')),
    "fixed body": change(
        (INERTIAL, INERTIAL + '<body pos="0 0 -0.3" euler="0.4 0 0"><geom type="box" size="0.01 0.02 0.03"/></body>')
    ),
    "mass of shapes": change((INERTIAL, "")),
    "mass of a shape": change((INERTIAL, ""), ('pos="0 0 -0.2" size="0.03"', 'pos="0 0 -0.2" size="0.03" mass="0.4"')),
    "density of a class": change(
        (INERTIAL, ""), ('<geom type="sphere" pos="0 0 -0.2"', '<geom class="heavy" type="sphere" pos="0 0 -0.2"')
    ),
    "childclass": change((INERTIAL, ""), ('body name="lower"', 'body name="lower" childclass="heavy"')),
    "inertiafromgeom": compiler('inertiafromgeom="true"'),
    "inertiafromgeom, a body without shapes": change(
        ('angle="radian"', 'angle="radian" inertiafromgeom="true"'),
        ('<geom type="sphere" pos="0 0 -0.2" size="0.03"/>', ""),
    ),
    "inertiagrouprange": change(
        ('angle="radian"', 'angle="radian" inertiagrouprange="0 1"'),
        (INERTIAL, '<geom type="ellipsoid" group="1" size="0.02 0.03 0.04"/><geom group="3" size="0.1"/>'),
    ),
    "settotalmass": compiler('settotalmass="30"'),
    "gear": motor('<motor joint="shoulder" gear="-6.33" ctrlrange="-3 2"/>'),
    "forcerange": motor('<motor joint="shoulder" ctrlrange="-20 20" forcerange="-5 6"/>'),
    "forcelimited false": motor('<motor joint="shoulder" ctrlrange="-20 20" forcelimited="false" forcerange="-5 5"/>'),
    "actuatorfrcrange": joint('actuatorfrcrange="-3 4"'),
    "actuatorfrclimited false": joint('actuatorfrcrange="-3 4" actuatorfrclimited="false"'),
    "several actuators": motor(
        MOTOR, '<position joint="shoulder" kp="0"/>', '<motor joint="shoulder" ctrlrange="-1 2"/>'
    ),
    "position": motor('<position joint="shoulder" kp="50" forcerange="-7 8"/>'),
    "velocity": motor('<velocity joint="shoulder" forcerange="-7 8"/>'),
    "range that is none": change(('range="-1 2"', 'range="0 0"')),
    "zeros in other words": change(
        ("<compiler", '<compiler boundmass="0.0"'), (RAIL, '<body name="rail" pos="-0.2 0 0" gravcomp="0.0">')
    ),
    "general": motor('<general joint="shoulder" gainprm="3" ctrlrange="-2 1"/>'),
    "one default for all actuators": change(("<default>\n", '<default>\n<position forcerange="-2 3"/>\n')),
    "default of general": change(("<default>\n", '<default>\n<general forcerange="-2 3"/>\n')),
    "furniture": change(
        (
            '<body name="base"',
            '<body name="table"><geom size="1"/><body><geom size="1"/></body></body><body name="base"',
        )
    ),
    "welded": change(("<freejoint/>", "")),
    "free joint by type": change(("<freejoint/>", '<joint type="free" armature="0" damping="0"/>')),
    "free joint that inherits": change(("<freejoint/>", '<joint type="free" frictionloss="0.1"/>')),
    "pairs": change(
        (
            "</worldbody>",
            '</worldbody><contact><pair geom1="bar" geom2="floor"/><pair geom1="floor" geom2="bar"/></contact>',
        )
    ),
    "sites, cameras, lights": change(("<freejoint/>", '<freejoint/><site name="imu"/><camera name="eye"/><light/>')),
    "option": change(
        (
            "<default>\n",
            '<option timestep="0.005" gravity="0 0 -9.81" cone="elliptic"><flag contact="enable"/></option>\n<default>\n',
        )
    ),
    "exclude": change(("<actuator>", '<contact><exclude body1="upper" body2="lower"/></contact><actuator>')),
    "asset and sensor": change(
        ("<worldbody>", '<asset><material name="m"/></asset><worldbody>'),
        ("</mujoco>", '<sensor><jointpos joint="elbow"/></sensor></mujoco>'),
    ),
}

REFUSED = {
    "springdamper": (joint('springdamper="0.1 1"'), "springdamper"),
    "ball": (change(('type="slide"', 'type="ball"'), (' axis="1 0 1" range="-0.1 0.2"', "")), "`type`"),
    "gravcomp": (change((RAIL, '<body name="rail" gravcomp="1">')), "gravcomp"),
    "balanceinertia": (compiler('balanceinertia="true"'), "balanceinertia"),
    "boundmass": (compiler('boundmass="1"'), "boundmass"),
    "alignfree": (compiler('alignfree="true"'), "alignfree"),
    "autolimits": (compiler('autolimits="false"'), "autolimits"),
    "mesh that has mass": (change((INERTIAL, '<geom type="mesh" mesh="m"/>')), "mesh"),
    "shellinertia": (change((INERTIAL, '<geom type="sphere" size="0.1" shellinertia="true"/>')), "shellinertia"),
    "equality": (change(("<actuator>", '<equality><connect name="loop" body1="lower" body2="rail" anchor="0 0 0"/></equality><actuator>')), "connect.*loop"),
    "coupled joints": (change(("<actuator>", '<equality><joint joint1="elbow" joint2="shoulder"/></equality><actuator>')), "<joint>.*<equality>"),
    "tendon": (change(("<actuator>", '<tendon><fixed name="t"><joint joint="elbow" coef="1"/></fixed></tendon><actuator>')), "<fixed>"),
    "damper": (motor('<damper joint="shoulder" kv="2" ctrlrange="0 1"/>'), "<damper>"),
    "muscle": (motor('<muscle joint="shoulder"/>'), "<muscle>"),
    "another transmission": (motor('<motor jointinparent="shoulder"/>'), "jointinparent"),
    "gravity": (change(("<default>\n", '<option gravity="0 0 -1.62"/>\n<default>\n')), "gravity"),
    "medium": (change(("<default>\n", '<option density="1000"/>\n<default>\n')), "density"),
    "disabled springs": (change(("<default>\n", '<option><flag spring="disable"/></option>\n<default>\n')), "spring"),
    "spring of a free joint": (change(("<freejoint/>", '<joint type="free" stiffness="3"/>')), "stiffness"),
    "frame at the centre of mass": (change(("<freejoint/>", '<freejoint align="true"/>')), "align"),
    "actuator without a joint": (motor('<motor joint="wrist"/>'), "wrist"),
    "unknown attribute": (joint('stickiness="1"'), "stickiness"),
    "composite": (change(("<freejoint/>", '<freejoint/><composite type="cable"/>')), "<composite>"),
    "two robots": (change((RAIL, f"</body><body>  <freejoint/> {RAIL}")), "both move freely"),
    "no mass": (change((INERTIAL, ""), ('<geom type="sphere" pos="0 0 -0.2" size="0.03"/>', "")), "`lower`.*no mass"),
    "general with a default of position": (change(("<default>\n", '<default>\n<position kp="5"/>\n'), (MOTOR, '<general joint="shoulder"/>')), "<general>"),
}  # fmt: skip

URDF = """<robot name="arm">
  <link name="base"><inertial><origin xyz="0 0 0.1" rpy="0.1 0.2 0.3"/><mass value="4"/>
    <inertia ixx="0.04" ixy="0.001" ixz="0.002" iyy="0.05" iyz="-0.001" izz="0.03"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0 0.1 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.011"/></inertial></link>
  <link name="tool"><inertial><mass value="0.3"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <link name="tip"><inertial><mass value="0.1"/>
    <inertia ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.0001"/></inertial></link>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.2" rpy="0.4 -0.2 0.1"/><parent link="base"/><child link="arm"/>
    <axis xyz="1 2 -1"/><limit lower="-1" upper="2" effort="30" velocity="5"/><dynamics damping="0.2" friction="0.1"/></joint>
  <joint name="reach" type="prismatic"><origin xyz="0 0.2 0"/><parent link="arm"/><child link="tool"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.3" effort="40" velocity="1"/></joint>
  <joint name="hold" type="fixed"><origin xyz="0 0.1 0.05" rpy="0 0 1"/><parent link="tool"/><child link="tip"/></joint>
</robot>
"""

TOOL_INERTIAL = '<inertial><mass value="0.3"/>\n    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>'

URDF_EQUAL = {
    "base": URDF,
    "no limits": URDF.replace('lower="-1" upper="2"', 'lower="0" upper="0"'),
    "a fixed inertia without mass": URDF.replace('<mass value="0.1"/>', '<mass value="0"/>'),
    "elements of others": URDF.replace('<link name="tip">', '<link name="tip"><origin xyz="1 2 3"/><speed/>'),
    "continuous": URDF.replace('type="revolute"', 'type="continuous"'),
    "no axis": URDF.replace('<axis xyz="1 2 -1"/>', ""),
    "mass of shapes": URDF.replace(TOOL_INERTIAL, '<collision><origin xyz="0.1 0 0" rpy="0.3 0 0"/><geometry><cylinder radius="0.03" length="0.2"/></geometry></collision>'),
    "floating": URDF.replace("</robot>", '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="base"/></joint></robot>'),
    "settotalmass": URDF.replace("</robot>", '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="base"/></joint><mujoco><compiler settotalmass="12"/></mujoco></robot>'),
}  # fmt: skip

URDF_REFUSED = {
    "mimic": (URDF.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="turn"/>'), "<mimic>"),
    "planar": (URDF.replace('type="prismatic"', 'type="planar"'), "planar"),
}


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings to the current folder."""
    monkeypatch.chdir(tmp_path)


def exported(path: Path) -> tuple[str, str]:
    run = subprocess.run([find_program(), "mjcf", "--model", str(path)], capture_output=True, text=True)
    return run.stdout, run.stderr


def limits(model) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest force of the actuators of each joint."""
    data = mujoco.MjData(model)
    forces = []
    for ctrl in (-1e9, 1e9):
        data.ctrl[:] = ctrl
        mujoco.mj_forward(model, data)
        forces.append(data.qfrc_actuator.copy())
    low, high = np.minimum(*forces), np.maximum(*forces)
    return {
        model.joint(j).name: (low[model.jnt_dofadr[j]], high[model.jnt_dofadr[j]])
        for j in range(model.njnt)
        if model.jnt_type[j] >= 2
    }


def stated_limits(model) -> dict[str, tuple[float, float]]:
    """Return the limits of the force of each joint of a model without actuators, such as that of a URDF."""
    joints = [model.joint(j) for j in range(model.njnt) if model.jnt_type[j] >= 2]
    return {
        joint.name: tuple(model.jnt_actfrcrange[joint.id]) if model.jnt_actfrclimited[joint.id] else (-1e9, 1e9)
        for joint in joints
    }


def order(model, names: list[str], base_free: bool) -> tuple[list[int], list[int]]:
    """Return the indices of the positions and of the velocities: the free base, then the joints with these names."""
    qpos = list(range(7)) if base_free else []
    dofs = list(range(6)) if base_free else []
    for name in names:
        qpos.append(model.joint(name).qposadr[0])
        dofs.append(model.joint(name).dofadr[0])
    return qpos, dofs


def compare(original, copy) -> None:
    names = sorted(original.joint(j).name for j in range(original.njnt) if original.jnt_type[j] >= 2)
    assert names == sorted(copy.joint(j).name for j in range(copy.njnt) if copy.jnt_type[j] >= 2)
    is_free = any(original.jnt_type == 0)
    assert is_free == any(copy.jnt_type == 0)
    for name in names:
        one, other = original.joint(name), copy.joint(name)
        limited = original.jnt_limited[one.id]
        assert limited == copy.jnt_limited[other.id]
        if limited:
            np.testing.assert_allclose(one.range, other.range, rtol=1e-12)
        for field in ("armature", "damping", "frictionloss"):
            np.testing.assert_allclose(getattr(one, field), getattr(other, field), rtol=1e-12)
    of_copy = limits(copy)
    for name, effort in (limits(original) if original.nu else stated_limits(original)).items():
        # An unlimited force is as large as the control.
        np.testing.assert_allclose(np.clip(effort, -1e8, 1e8), np.clip(of_copy[name], -1e8, 1e8), rtol=1e-9, atol=1e-12)
    random = np.random.default_rng(1)
    indices = [order(model, names, is_free) for model in (original, copy)]
    for _ in range(5):
        values, rates = random.normal(size=len(indices[0][0])), random.normal(size=len(indices[0][1]))
        if is_free:
            values[3:7] /= np.linalg.norm(values[3:7])
        found = []
        for model, (qpos, dofs) in zip((original, copy), indices, strict=True):
            data = mujoco.MjData(model)
            data.qpos[qpos], data.qvel[dofs] = values, rates
            mujoco.mj_forward(model, data)
            mass = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, mass)
            forces = (data.qfrc_bias[dofs], data.qfrc_passive[dofs], model.dof_frictionloss[dofs])
            found.append((mass[np.ix_(dofs, dofs)], *forces))
        for one, other in zip(*found, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(one).max())


@pytest.mark.parametrize("name", EQUAL)
def test_mjcf_is_read_as_mujoco_compiles_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(EQUAL[name])
    text, notes = exported(path)
    assert text, notes
    compare(mujoco.MjModel.from_xml_string(EQUAL[name]), mujoco.MjModel.from_xml_string(text))


PAIRED = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="base"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
    <body><joint name="knee"/><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <geom name="foot" type="sphere" size="0.123"/><geom name="hand" type="sphere" size="0.321"/></body>
  </body>
  <body name="ball" pos="1 0 0"><freejoint/><geom type="sphere" size="0.2" mass="1"/></body>
  <body name="door" pos="2 0 0"><joint name="hinge"/><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/></body>
</worldbody><actuator><motor name="knee" joint="knee"/></actuator>
<contact><pair geom1="floor" geom2="foot"/><pair geom1="hand" geom2="foot"/></contact></mujoco>"""


def test_objects_beside_a_robot_are_left_out_and_paired_shapes_touch_the_ground(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(PAIRED)
    text, notes = exported(path)
    model = mujoco.MjModel.from_xml_string(text)
    assert [model.joint(j).name for j in range(1, model.njnt)] == ["knee"]
    assert "0.123" in text
    assert "0.321" not in text
    for note in ("body `ball` has no actuator", "body `door` has no actuator", "contacts between shapes of the robot"):
        assert note in notes


@pytest.mark.parametrize("name", REFUSED)
def test_mjcf_that_is_not_supported_is_refused_by_name(name: str, tmp_path: Path) -> None:
    text, words = REFUSED[name]
    path = tmp_path / "robot.xml"
    path.write_text(text)
    printed, error = exported(path)
    assert not printed
    assert re.search(words, error.replace("\n", " ")), error


@pytest.mark.parametrize("name", URDF_EQUAL)
def test_urdf_is_read_as_mujoco_compiles_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(URDF_EQUAL[name])
    text, notes = exported(path)
    assert text, notes
    original = mujoco.MjModel.from_xml_string(URDF_EQUAL[name])
    if "floating" not in URDF_EQUAL[name]:
        # MuJoCo welds a base of which the file says nothing; here it moves freely.
        text = text.replace("<freejoint/>", "")
    compare(original, mujoco.MjModel.from_xml_string(text))


@pytest.mark.parametrize("name", URDF_REFUSED)
def test_urdf_that_is_not_supported_is_refused_by_name(name: str, tmp_path: Path) -> None:
    text, words = URDF_REFUSED[name]
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    printed, error = exported(path)
    assert not printed
    assert words in error


def test_included_files_are_read_from_the_folder_of_the_robot(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    rail = BASE[BASE.index(RAIL) : BASE.index("</body>\n    </body>\n  </worldbody>") + len("</body>")]
    (tmp_path / "parts" / "rail.xml").write_text(f"<mujocoinclude>{rail}</mujocoinclude>")
    path = tmp_path / "robot.xml"
    path.write_text(BASE.replace(rail, '<include file="parts/rail.xml"/>'))
    text, notes = exported(path)
    assert text, notes
    compare(mujoco.MjModel.from_xml_path(str(path)), mujoco.MjModel.from_xml_string(text))
