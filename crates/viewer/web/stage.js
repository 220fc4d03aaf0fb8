// The stage: robots, ground, light and camera.
import {
  ArrowHelper, Color, DirectionalLight, Fog, Group, HemisphereLight, Mesh, MeshStandardMaterial, OrbitControls,
  PerspectiveCamera, Raycaster, Scene, Vector2, Vector3, WebGLRenderer,
} from 'three';
import { bodyGeometry, fieldGround, levelGround, place } from 'twinstep/shapes';

// Distance of neighbouring robots [m].
const SPACING = 1.5;
// Newtons that an arrow of one metre stands for.
const FORCE_SCALE = 250;
const SKY = 0xd9e3ec;
const FULL_TORQUE = new Color(0xff5a00);
// Tiles along each side of level ground, and half the width of the part that has shadows [m].
const GROUND_TILES = 96;
const SHADOW_REACH = 3;
// Where a ghost and its robot are in one place, the robot is seen.
const BEHIND = { depthWrite: false, polygonOffset: true, polygonOffsetFactor: 4, polygonOffsetUnits: 4 };
// Vertical field of view of a window that is wider than high [deg].
const FIELD_OF_VIEW = 40;
// Time in which the camera comes most of the way to the height of a robot that climbs [s].
const CLIMB = 0.3;
// From the camera's target to the sun [m].
const SUN = new Vector3(2.5, -3.5, 6);

// Torque of a joint by its limit; not a number if one of them is not known.
export function shareOfLimit(info, state, joint) {
  return Math.abs(state.torque[joint]) / (info.torque_limits[joint] ?? NaN);
}

export class Stage {
  constructor(canvas) {
    // A canvas that has its size from the start is not allocated twice.
    const pixelRatio = Math.min(devicePixelRatio, 2);
    [canvas.width, canvas.height] = [Math.floor(innerWidth * pixelRatio), Math.floor(innerHeight * pixelRatio)];
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(pixelRatio);
    this.renderer.shadowMap.enabled = true;
    this.scene = new Scene();
    this.scene.background = new Color(SKY);
    this.scene.fog = new Fog(SKY, 9, 22);
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 60);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(1.25, -1.55, 0.85);
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.target.set(0, 0, 0.22);
    this.orbit.enableDamping = true;
    this.scene.add(new HemisphereLight(0xeaf2ff, 0x8a857c, 1.5));
    this.sun = new DirectionalLight(0xfff4e6, 2.4);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(2048, 2048);
    this.sun.shadow.normalBias = 0.01;
    Object.assign(this.sun.shadow.camera, {
      left: -SHADOW_REACH, right: SHADOW_REACH, top: SHADOW_REACH, bottom: -SHADOW_REACH, near: 1, far: 16,
    });
    this.scene.add(this.sun, this.sun.target);
    this.robots = [];
  }

  begin(info) {
    this.info = info;
    this.geometries = info.bodies.map((_, body) => bodyGeometry(info.shapes, body));
    const ground = info.heights ? fieldGround(info.heights, GROUND_TILES) : levelGround(GROUND_TILES);
    this.ground = new Mesh(ground, new MeshStandardMaterial({ vertexColors: true, roughness: 0.95 }));
    this.ground.receiveShadow = true;
    // Feet are a little in the ground.
    this.ground.position.z = -0.002;
    this.scene.add(this.ground);
    // Ground that rises behind the camera does not hide the robot.
    if (info.heights) this.camera.position.z += 1;
    this.resize();
  }

  // Shows the robots of a frame; the camera moves with the one that is followed.
  draw(frame, followed) {
    if (this.robots.length !== frame.robots) this.#makeRobots(frame);
    frame.states.forEach((state, index) => this.#pose(this.robots[index], state));
    const trunk = this.robots[followed]?.bodies[0];
    this.drawn ??= performance.now();
    if (trunk) {
      const shift = trunk.getWorldPosition(new Vector3()).sub(this.orbit.target);
      // The height of a robot is seen against level ground; on other ground the camera climbs with it, slowly.
      const elapsed = (performance.now() - this.drawn) / 1000;
      shift.z *= this.info.heights ? 1 - Math.exp(-elapsed / CLIMB) : 0;
      this.orbit.target.add(shift);
      this.camera.position.add(shift);
    }
    this.drawn = performance.now();
  }

  render() {
    this.orbit.update();
    const { target } = this.orbit;
    this.sun.target.position.copy(target);
    this.sun.position.copy(target).add(SUN);
    // Two tiles are a period of the level ground, which is without end.
    if (this.ground && !this.info.heights) this.ground.position.setX(Math.round(target.x)).setY(Math.round(target.y));
    this.renderer.render(this.scene, this.camera);
  }

  resize() {
    const size = this.renderer.getSize(new Vector2());
    if (size.x !== innerWidth || size.y !== innerHeight) this.renderer.setSize(innerWidth, innerHeight, false);
    const { camera } = this;
    camera.aspect = innerWidth / innerHeight;
    // A high window shows as much of the width as a square one.
    const half = Math.tan((FIELD_OF_VIEW * Math.PI) / 360) / Math.min(camera.aspect, 1);
    camera.fov = (360 / Math.PI) * Math.atan(half);
    // The robot is in the middle of what the panel leaves free.
    const panel = document.getElementById('panel').getBoundingClientRect();
    const isBelow = panel.width > 0.9 * innerWidth;
    const [right, down] = isBelow ? [0, innerHeight - panel.top] : [panel.width, 0];
    camera.setViewOffset(innerWidth, innerHeight, right / 2, down / 2, innerWidth, innerHeight);
  }

  arrow(color) {
    const made = new ArrowHelper(new Vector3(0, 0, 1), new Vector3(), 1, color, 0.05, 0.03);
    made.visible = false;
    this.scene.add(made);
    return made;
  }

  rayAt(event) {
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight), this.camera);
    return ray;
  }

  robotAt(event) {
    return this.rayAt(event).intersectObjects(this.robots.map((robot) => robot.root), true)[0]?.object.userData.robot;
  }

  trunkOf(robot) {
    return this.robots[robot].bodies[0].getWorldPosition(new Vector3());
  }

  #makeRobots(frame) {
    for (const robot of this.robots) {
      this.scene.remove(robot.root, robot.command, robot.velocity, ...robot.forces);
      if (robot.ghost) this.scene.remove(robot.ghost.root);
    }
    // On level ground each robot has a world of its own: they are put beside each other.
    const spacing = this.info.heights ? 0 : SPACING;
    const side = Math.ceil(Math.sqrt(frame.robots));
    const middle = (side - 1) / 2;
    this.robots = frame.states.map((_, index) => {
      const robot = this.#build(false);
      robot.root.position.set(spacing * (Math.floor(index / side) - middle), spacing * ((index % side) - middle), 0);
      robot.root.traverse((object) => { object.userData.robot = index; });
      return {
        ...robot,
        ghost: this.info.has_ghost ? this.#build(true) : null,
        forces: this.info.contacts.map(() => this.arrow(0x1f9d55)),
        command: this.arrow(0xf0a000),
        velocity: this.arrow(0x1473e6),
      };
    });
    // A robot may hang above the ground.
    const height = frame.states[0].poses[2];
    this.camera.position.z += height - this.orbit.target.z;
    this.orbit.target.z = height;
  }

  // One robot: a mesh for each body, each with its material, because its colour is that of its joint's torque.
  #build(isGhost) {
    const root = new Group();
    const bodies = this.geometries.map((geometry) => {
      const material = new MeshStandardMaterial(isGhost
        ? { color: 0x2f8cff, transparent: true, opacity: 0.5, ...BEHIND }
        : { vertexColors: true, roughness: 0.55, metalness: 0.1 });
      const mesh = new Mesh(geometry, material);
      mesh.castShadow = !isGhost;
      mesh.receiveShadow = !isGhost;
      root.add(mesh);
      return mesh;
    });
    this.scene.add(root);
    return { root, bodies };
  }

  #pose(robot, state) {
    const { info } = this;
    robot.bodies.forEach((body, index) => place(body, state.poses, 7 * index));
    if (robot.ghost) {
      robot.ghost.root.visible = Number.isFinite(state.ghost[0]);
      if (robot.ghost.root.visible) robot.ghost.bodies.forEach((body, index) => place(body, state.ghost, 7 * index));
    }
    info.joints.forEach((_, joint) => {
      const share = Math.min(1, shareOfLimit(info, state, joint));
      robot.bodies[1 + joint]?.material.emissive.copy(FULL_TORQUE).multiplyScalar(Number.isFinite(share) ? 0.9 * share ** 1.5 : 0);
    });
    robot.root.updateMatrixWorld(true);
    robot.forces.forEach((made, index) => {
      const { body, position } = info.contacts[index];
      const at = robot.bodies[body].localToWorld(new Vector3(...position));
      showArrow(made, at, new Vector3(0, 0, 1), Number.isFinite(state.force[index]) ? state.force[index] / FORCE_SCALE : 0);
    });
    const above = robot.bodies[0].localToWorld(new Vector3(0, 0, 0.15));
    for (const [made, value, height] of [[robot.command, state.command, 0.02], [robot.velocity, state.velocity, 0]]) {
      const planar = new Vector3(value[0], value[1], 0).applyQuaternion(robot.bodies[0].quaternion).setZ(0);
      const from = above.clone();
      from.z += height;
      showArrow(made, from, planar.clone(), Number.isFinite(value[0]) ? 0.6 * planar.length() : 0);
    }
  }
}

export function showArrow(made, from, direction, length) {
  made.visible = length > 0.01;
  if (!made.visible) return;
  made.position.copy(from);
  made.setDirection(direction.normalize());
  made.setLength(length, Math.min(0.08, 0.4 * length), Math.min(0.05, 0.25 * length));
}
