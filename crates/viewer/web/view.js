// The page: draws the robots of the newest frame, shows their numbers, and sends the requests of its controls.
import {
  ArrowHelper, BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, DirectionalLight, Fog, GridHelper,
  Group, HemisphereLight, Mesh, MeshStandardMaterial, OrbitControls, PerspectiveCamera, PlaneGeometry, Raycaster, Scene,
  SphereGeometry, Vector2, Vector3, WebGLRenderer,
} from './three.min.js';
import { Recording } from './recording.js';

const JOINTS = 12;
const MAX_ROBOTS = 64;
const LEGS = 4;
const FEET = ['FL', 'FR', 'RL', 'RR'];
const CURVE_POINTS = 600;
// Distance of neighbouring robots [m].
const SPACING = 1.5;
// Newtons that an arrow of one metre stands for.
const FORCE_SCALE = 250;
const IDLE = new Color(0x9aa3ad);
const FULL = new Color(0xff7a1a);

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get('token');
const url = (path) => (token ? `${path}?token=${encodeURIComponent(token)}` : path);
// A page that is a file has scene and frames inside.
const recording = globalThis.recordedFrames ? new Recording(globalThis.recordedFrames) : null;

const renderer = new WebGLRenderer({ canvas: $('scene'), antialias: true });
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
const scene = new Scene();
scene.background = new Color(0x20242b);
scene.fog = new Fog(0x20242b, 12, 40);
const camera = new PerspectiveCamera(45, 1, 0.05, 100);
camera.up.set(0, 0, 1);
camera.position.set(1.4, -1.6, 0.9);
const orbit = new OrbitControls(camera, renderer.domElement);
orbit.target.set(0, 0, 0.25);
orbit.enableDamping = true;
scene.add(new HemisphereLight(0xffffff, 0x445566, 1.6));
const sun = new DirectionalLight(0xffffff, 1.8);
sun.position.set(2, -3, 5);
scene.add(sun);

let info;
let robots = [];
let chosen = 0;
let follows = true;
let newest = null;
let received = 0;
let drawn = 0;
const curves = new Map();

function geometry(shape) {
  const [a, b, c] = shape.size;
  if (shape.kind === 'box') return new BoxGeometry(2 * a, 2 * b, 2 * c);
  if (shape.kind === 'sphere') return new SphereGeometry(a, 16, 12);
  // Capsules of three.js lie along y, those of a robot along z.
  return new CapsuleGeometry(a, 2 * b, 6, 12).rotateX(Math.PI / 2);
}

function place(object, pose, at) {
  object.position.set(pose[at], pose[at + 1], pose[at + 2]);
  object.quaternion.set(pose[at + 4], pose[at + 5], pose[at + 6], pose[at + 3]);
}

// One robot: a group for each body, with a material for each joint.
function build(isGhost) {
  const root = new Group();
  const bodies = info.bodies.map(() => new Group());
  bodies.forEach((body) => root.add(body));
  const materials = info.bodies.map((_, body) => new MeshStandardMaterial(isGhost
    ? { color: 0x4fa3ff, transparent: true, opacity: 0.45, roughness: 0.8, depthWrite: false }
    : { color: body === 0 ? 0x3c424b : 0x9aa3ad, roughness: 0.65 }));
  for (const shape of info.shapes) {
    const mesh = new Mesh(geometry(shape), materials[shape.body]);
    place(mesh, shape.offset, 0);
    bodies[shape.body].add(mesh);
  }
  scene.add(root);
  return { root, bodies, materials };
}

function arrow(color) {
  const made = new ArrowHelper(new Vector3(0, 0, 1), new Vector3(), 1, color, 0.05, 0.03);
  made.visible = false;
  scene.add(made);
  return made;
}

function makeRobots(count) {
  for (const robot of robots) {
    scene.remove(robot.root, robot.command, robot.velocity, ...robot.forces);
    if (robot.ghost) scene.remove(robot.ghost.root);
  }
  chosen = Math.min(chosen, count - 1);
  // Each robot has a world of its own: they are put beside each other.
  const side = Math.ceil(Math.sqrt(count));
  const middle = (side - 1) / 2;
  robots = Array.from({ length: count }, (_, index) => {
    const robot = build(false);
    robot.root.position.set(SPACING * (Math.floor(index / side) - middle), SPACING * ((index % side) - middle), 0);
    robot.root.traverse((object) => { object.userData.robot = index; });
    return {
      ...robot,
      ghost: info.has_ghost ? build(true) : null,
      forces: FEET.map(() => arrow(0x7bd88f)),
      command: arrow(0xffd866),
      velocity: arrow(0x78dce8),
    };
  });
}

function makeGround() {
  const field = info.heights;
  if (!field) {
    const grid = new GridHelper(60, 120, 0x8a95a3, 0x59626e);
    grid.rotation.x = Math.PI / 2;
    const floor = new Mesh(new PlaneGeometry(60, 60), new MeshStandardMaterial({
      color: 0x2a2f37, roughness: 1, polygonOffset: true, polygonOffsetFactor: 4, polygonOffsetUnits: 4,
    }));
    floor.position.z = -0.004;
    scene.add(grid, floor);
    return;
  }
  const [nx, ny] = field.shape;
  const points = new Float32Array(3 * nx * ny);
  const faces = [];
  for (let i = 0; i < nx; i += 1) {
    for (let j = 0; j < ny; j += 1) {
      const at = i * ny + j;
      points.set([field.origin[0] + i * field.cell_size, field.origin[1] + j * field.cell_size, field.heights[at]], 3 * at);
      if (i + 1 < nx && j + 1 < ny) faces.push(at, at + ny, at + 1, at + 1, at + ny, at + ny + 1);
    }
  }
  const ground = new BufferGeometry();
  ground.setAttribute('position', new BufferAttribute(points, 3));
  ground.setIndex(faces);
  ground.computeVertexNormals();
  scene.add(new Mesh(ground, new MeshStandardMaterial({ color: 0x4a525d, roughness: 1, flatShading: true })));
}

// Splits a frame into its parts. crates/viewer/src/frame.rs has the layout.
function decode(payload) {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  const length = view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(payload.subarray(4, 4 + length)));
  const numbers = new Float32Array(payload.slice(4 + length).buffer);
  const poses = 7 * info.bodies.length;
  const stride = poses * (info.has_ghost ? 2 : 1) + JOINTS + LEGS + 6;
  header.robots = Math.min(header.robots, MAX_ROBOTS);
  header.states = Array.from({ length: header.robots }, (_, robot) => {
    let at = robot * stride;
    const take = (count) => { at += count; return numbers.subarray(at - count, at); };
    return {
      poses: take(poses),
      ghost: info.has_ghost ? take(poses) : null,
      torque: take(JOINTS),
      force: take(LEGS),
      command: take(3),
      velocity: take(3),
    };
  });
  return header;
}

function showArrow(made, from, direction, length) {
  made.visible = length > 0.01;
  if (!made.visible) return;
  made.position.copy(from);
  made.setDirection(direction.normalize());
  made.setLength(length, Math.min(0.08, 0.4 * length), Math.min(0.05, 0.25 * length));
}

function footPosition(robot, leg) {
  const foot = info.shapes.filter((shape) => shape.kind === 'sphere' && shape.body === 3 + 3 * leg).pop();
  const position = foot ? new Vector3(...foot.offset.slice(0, 3)) : new Vector3();
  return robot.bodies[3 + 3 * leg].localToWorld(position);
}

function draw(frame) {
  if (robots.length !== frame.robots) {
    makeRobots(frame.robots);
    // A robot may hang above the ground.
    const height = frame.states[0].poses[2];
    camera.position.z += height - orbit.target.z;
    orbit.target.z = height;
  }
  frame.states.forEach((state, index) => {
    const robot = robots[index];
    info.bodies.forEach((_, body) => place(robot.bodies[body], state.poses, 7 * body));
    if (robot.ghost) {
      robot.ghost.root.visible = Number.isFinite(state.ghost[0]);
      if (robot.ghost.root.visible) info.bodies.forEach((_, body) => place(robot.ghost.bodies[body], state.ghost, 7 * body));
    }
    for (let joint = 0; joint < JOINTS; joint += 1) {
      const share = Math.min(1, Math.abs(state.torque[joint]) / info.torque_limits[joint]);
      robot.materials[1 + joint]?.color.lerpColors(IDLE, FULL, Number.isFinite(share) ? share : 0);
    }
    robot.root.updateMatrixWorld(true);
    robot.forces.forEach((made, leg) => {
      const force = state.force[leg];
      showArrow(made, footPosition(robot, leg), new Vector3(0, 0, 1), Number.isFinite(force) ? force / FORCE_SCALE : 0);
    });
    const above = robot.bodies[0].localToWorld(new Vector3(0, 0, 0.15));
    for (const [made, value, height] of [[robot.command, state.command, 0.02], [robot.velocity, state.velocity, 0]]) {
      const planar = new Vector3(value[0], value[1], 0).applyQuaternion(robot.bodies[0].quaternion).setZ(0);
      const from = above.clone();
      from.z += height;
      showArrow(made, from, planar.clone(), Number.isFinite(value[0]) ? 0.6 * planar.length() : 0);
    }
  });
  if (follows && frame.states[chosen]) {
    const trunk = robots[chosen].bodies[0].getWorldPosition(new Vector3());
    const shift = trunk.sub(orbit.target).setZ(0);
    orbit.target.add(shift);
    camera.position.add(shift);
  }
}

function number(value, digits = 2) {
  return Number.isFinite(value) ? value.toFixed(digits) : '–';
}

function showFacts(frame) {
  const state = frame.states[chosen] ?? frame.states[0];
  if (!state) return;
  const rows = [['robot', `${chosen + 1} of ${frame.robots}`], ['time', `${frame.time.toFixed(2)} s`]];
  if (Number.isFinite(state.command[0])) rows.push(['commanded', `${[...state.command].map((v) => number(v)).join(' ')}`]);
  if (Number.isFinite(state.velocity[0])) rows.push(['velocity', `${[...state.velocity].map((v) => number(v)).join(' ')}`]);
  if (Number.isFinite(state.torque[0])) {
    const largest = Math.max(...state.torque.map((tau, joint) => Math.abs(tau) / info.torque_limits[joint]));
    rows.push(['largest torque', `${(100 * largest).toFixed(0)} % of its limit`]);
  }
  if (state.ghost && Number.isFinite(state.ghost[0])) {
    const error = Math.hypot(...[0, 1, 2].map((axis) => state.ghost[axis] - state.poses[axis]));
    rows.push(['simulated trunk is off by', `${(1000 * error).toFixed(1)} mm`]);
  }
  const table = document.createElement('table');
  for (const row of rows) {
    const line = table.insertRow();
    row.forEach((text) => { line.insertCell().textContent = text; });
  }
  $('facts').replaceChildren(table);
}

function addCurves(frame) {
  for (const [name, value] of Object.entries(frame.curves)) {
    if (!curves.has(name)) {
      const figure = document.createElement('figure');
      const caption = document.createElement('figcaption');
      const label = document.createElement('span');
      label.textContent = name;
      const shown = document.createElement('span');
      caption.append(label, shown);
      const canvas = document.createElement('canvas');
      canvas.width = 460;
      canvas.height = 96;
      figure.append(caption, canvas);
      $('curves').append(figure);
      curves.set(name, { values: [], canvas, shown });
    }
    const curve = curves.get(name);
    curve.values.push(value);
    if (!recording && curve.values.length > CURVE_POINTS) curve.values.shift();
  }
}

// The last 20 s, or everything that was recorded with a line at the time that is shown.
function drawCurves() {
  const share = recording ? recording.time / (recording.duration || 1) : null;
  for (const { values, canvas, shown } of curves.values()) {
    const points = recording ? values.length - 1 || 1 : CURVE_POINTS;
    const known = values.filter(Number.isFinite);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    const span = high - low || 1;
    const context = canvas.getContext('2d');
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.strokeStyle = '#ffd866';
    context.lineWidth = 2;
    context.beginPath();
    values.forEach((value, index) => {
      context.lineTo((index / points) * canvas.width, canvas.height - 6 - ((value - low) / span) * (canvas.height - 12));
    });
    context.stroke();
    if (recording) {
      context.fillStyle = '#e8eaed';
      context.fillRect(share * canvas.width - 1, 0, 2, canvas.height);
    }
    shown.textContent = number(values[recording ? Math.round(share * points) : values.length - 1], 3);
  }
}

function resize() {
  renderer.setSize(innerWidth, innerHeight, false);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}

function animate() {
  if (newest) {
    draw(newest);
    showFacts(newest);
    showPlayback(newest.playback, newest.time);
    newest = null;
    drawn += 1;
    if (drawn === 1) document.body.dataset.firstFrameMs = performance.now();
    document.body.dataset.frames = drawn;
  }
  orbit.update();
  renderer.render(scene, camera);
  requestAnimationFrame(animate);
}

// Requests of the controls.
async function ask(request) {
  if (recording) { recording.obey(request); return; }
  await fetch(url('request'), {
    method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify(request),
  });
}

// One request at a time, so that the newest velocity arrives last.
let [wanted, isSteering] = [null, false];
async function steer(velocity) {
  wanted = velocity;
  if (isSteering) return;
  isSteering = true;
  while (wanted) {
    const next = wanted;
    wanted = null;
    try { await ask({ velocity: next }); } catch { break; }
  }
  isSteering = false;
}

let isPaused = false;
let isSeeking = false;

function showPlayback(playback, time) {
  if (!playback) return;
  isPaused = playback.is_paused;
  $('pause').textContent = isPaused ? 'play' : 'pause';
  if (playback.duration !== null) {
    $('seek').hidden = false;
    $('seek').max = playback.duration;
    if (!isSeeking) $('seek').value = time;
  }
}

function connectControls() {
  if (!info.is_interactive && !info.velocity_bounds) return;
  $('controls').hidden = false;
  ['playback', 'robots'].forEach((group) => { $(group).hidden = !info.is_interactive; });
  $('pause').onclick = () => ask({ pause: !isPaused });
  $('speed').onchange = () => ask({ speed: Number($('speed').value) });
  $('seek').oninput = () => { isSeeking = true; ask({ seek: Number($('seek').value) }); };
  $('seek').onchange = () => { isSeeking = false; };
  if (!info.velocity_bounds) { $('robots').hidden = true; return; }
  $('velocity').hidden = false;
  const sliders = ['vx', 'vy', 'wz'].map($);
  sliders.forEach((slider, axis) => {
    [slider.min, slider.max] = info.velocity_bounds[axis];
    slider.value = 0;
    slider.oninput = () => send();
  });
  let heartbeat = null;
  const send = () => {
    steer(sliders.map((slider) => Number(slider.value)));
    // A run stops its robot when this page is gone.
    if (!info.is_interactive) heartbeat ??= setInterval(send, 500);
  };
  $('stop').onclick = () => { sliders.forEach((slider) => { slider.value = 0; }); send(); };
  $('push').onclick = () => {
    const angle = 2 * Math.PI * Math.random();
    ask({ push: { robot: chosen, velocity: [Math.cos(angle), Math.sin(angle), 0] } });
  };
  $('reset').onclick = () => ask({ reset: null });
}

function choose(event) {
  const point = new Vector2((2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight);
  const ray = new Raycaster();
  ray.setFromCamera(point, camera);
  const hit = ray.intersectObjects(robots.map((robot) => robot.root), true)[0];
  if (hit) { chosen = hit.object.userData.robot; follows = true; }
}

let pressed = [0, 0];
renderer.domElement.addEventListener('pointerdown', (event) => { pressed = [event.clientX, event.clientY]; });
renderer.domElement.addEventListener('pointerup', (event) => {
  if (Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 4) choose(event);
});
addEventListener('keydown', (event) => { if (event.key === 'f') follows = !follows; });
addEventListener('resize', resize);

// Reads the endless response, and keeps the newest frame.
async function read() {
  const response = await fetch(url('frames'));
  if (!response.ok) throw new Error(await response.text());
  const reader = response.body.getReader();
  let rest = new Uint8Array(0);
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const joined = new Uint8Array(rest.length + value.length);
    joined.set(rest);
    joined.set(value, rest.length);
    rest = joined;
    while (rest.length >= 4) {
      const length = new DataView(rest.buffer, rest.byteOffset).getUint32(0, true);
      if (rest.length < 8 + length) break;
      newest = decode(rest.subarray(4, 8 + length));
      rest = rest.slice(8 + length);
      received += 1;
      addCurves(newest);
    }
  }
}

async function connect() {
  for (;;) {
    try {
      await read();
      $('status').textContent = 'the program has ended';
    } catch (error) {
      $('status').textContent = `no connection: ${error.message}`;
    }
    await new Promise((wake) => { setTimeout(wake, 1000); });
  }
}

async function play() {
  let last = performance.now();
  recording.frames.forEach((frame) => addCurves(decode(frame)));
  for (;;) {
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    const payload = recording.advance((now - last) / 1000);
    last = now;
    newest = decode(payload);
    newest.playback = recording.playback;
    received += 1;
    drawCurves();
  }
}

async function start() {
  if (recording) {
    info = globalThis.recordedScene;
  } else {
    const response = await fetch(url('scene'));
    if (!response.ok) { $('status').textContent = await response.text(); return; }
    info = await response.json();
  }
  $('title').textContent = info.title;
  document.title = info.title;
  $('ghost-legend').hidden = !info.has_ghost;
  makeGround();
  connectControls();
  resize();
  animate();
  let [lastReceived, lastDrawn] = [0, 0];
  setInterval(() => {
    if (received > lastReceived) $('status').textContent = `${drawn - lastDrawn} frames/s`;
    else if (received > 0) $('status').textContent = 'waits for the next frame';
    [lastReceived, lastDrawn] = [received, drawn];
    if (!recording) drawCurves();
  }, 1000);
  if (recording) play(); else connect();
}

start();
