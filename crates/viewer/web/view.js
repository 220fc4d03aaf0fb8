// The page: draws the robots of the newest frame, shows their numbers, and sends the requests of its controls.
import {
  ArrowHelper, BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, DirectionalLight, Fog, Group,
  HemisphereLight, LineBasicMaterial, LineSegments, Mesh, MeshLambertMaterial, OrbitControls, PerspectiveCamera, Plane,
  PlaneGeometry, Raycaster, Scene, SphereGeometry, Vector2, Vector3, WebGLRenderer,
} from './three.min.js';
import { Recording } from './recording.js';

const MAX_ROBOTS = 64;
const CURVE_POINTS = 600;
// Distance of neighbouring robots [m].
const SPACING = 1.5;
// Newtons that an arrow of one metre stands for.
const FORCE_SCALE = 250;
// Velocity that a push adds for each metre of its arrow [1/s], and the largest one [m/s].
const PUSH_SCALE = 3;
const MAX_PUSH = 3;
const IDLE = new Color(0x9aa3ad);
const FULL = new Color(0xff7a1a);

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get('token');
const url = (path) => (token ? `${path}?token=${encodeURIComponent(token)}` : path);
// A page that is a file has scene and frames inside.
const recording = globalThis.recordedFrames ? new Recording(globalThis.recordedFrames) : null;

// The answers arrive while the graphics start.
const sceneAnswer = recording ? null : fetch(url('scene'));
let framesAnswer = recording ? null : fetch(url('frames'));
// Either may be wanted only after it has failed.
for (const answer of [sceneAnswer, framesAnswer]) answer?.catch(() => {});

// A canvas that has its size from the start is not allocated twice.
const pixelRatio = Math.min(devicePixelRatio, 2);
[$('scene').width, $('scene').height] = [Math.floor(innerWidth * pixelRatio), Math.floor(innerHeight * pixelRatio)];
const renderer = new WebGLRenderer({ canvas: $('scene'), antialias: true });
renderer.setPixelRatio(pixelRatio);
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
  const materials = info.bodies.map((_, body) => new MeshLambertMaterial(isGhost
    ? { color: 0x4fa3ff, transparent: true, opacity: 0.45, depthWrite: false }
    : { color: body === 0 ? 0x5a626e : 0x9aa3ad }));
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
      forces: info.contacts.map(() => arrow(0x7bd88f)),
      command: arrow(0xffd866),
      velocity: arrow(0x78dce8),
    };
  });
}

// Lines on the ground from -size to size [m], of pieces of 1 m: renderers in software drop lines that begin behind the camera.
function grid(size, cell) {
  const points = [];
  for (let at = -size; at <= size; at += cell) {
    for (let from = -size; from < size; from += 1) points.push(at, from, 0, at, from + 1, 0, from, at, 0, from + 1, at, 0);
  }
  const lines = new BufferGeometry();
  lines.setAttribute('position', new BufferAttribute(new Float32Array(points), 3));
  return new LineSegments(lines, new LineBasicMaterial({ color: 0x59626e }));
}

function makeGround() {
  const field = info.heights;
  if (!field) {
    const floor = new Mesh(new PlaneGeometry(60, 60), new MeshLambertMaterial({
      color: 0x2a2f37, polygonOffset: true, polygonOffsetFactor: 4, polygonOffsetUnits: 4,
    }));
    floor.position.z = -0.004;
    scene.add(grid(20, 0.5), floor);
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
  scene.add(new Mesh(ground, new MeshLambertMaterial({ color: 0x4a525d, flatShading: true })));
}

// Splits a frame into its parts. crates/viewer/src/frame.rs has the layout.
function decode(payload) {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  const length = view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(payload.subarray(4, 4 + length)));
  const numbers = new Float32Array(payload.slice(4 + length).buffer);
  const poses = 7 * info.bodies.length;
  const stride = poses * (info.has_ghost ? 2 : 1) + header.joints + header.contacts + 6 + info.robot_curves.length;
  header.robots = Math.min(header.robots, MAX_ROBOTS);
  header.states = Array.from({ length: header.robots }, (_, robot) => {
    let at = robot * stride;
    const take = (count) => { at += count; return numbers.subarray(at - count, at); };
    return {
      poses: take(poses),
      ghost: info.has_ghost ? take(poses) : null,
      torque: take(header.joints),
      force: take(header.contacts),
      command: take(3),
      velocity: take(3),
      curves: take(info.robot_curves.length),
    };
  });
  return header;
}

// Torque of a joint by its limit; not a number if one of them is not known.
function shareOfLimit(state, joint) {
  return Math.abs(state.torque[joint]) / (info.torque_limits[joint] ?? NaN);
}

function showArrow(made, from, direction, length) {
  made.visible = length > 0.01;
  if (!made.visible) return;
  made.position.copy(from);
  made.setDirection(direction.normalize());
  made.setLength(length, Math.min(0.08, 0.4 * length), Math.min(0.05, 0.25 * length));
}

function contactPosition(robot, contact) {
  return robot.bodies[contact.body].localToWorld(new Vector3(...contact.position));
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
    info.joints.forEach((_, joint) => {
      const share = Math.min(1, shareOfLimit(state, joint));
      robot.materials[1 + joint]?.color.lerpColors(IDLE, FULL, Number.isFinite(share) ? share : 0);
    });
    robot.root.updateMatrixWorld(true);
    robot.forces.forEach((made, index) => {
      const force = state.force[index];
      showArrow(made, contactPosition(robot, info.contacts[index]), new Vector3(0, 0, 1), Number.isFinite(force) ? force / FORCE_SCALE : 0);
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
  const shares = info.joints.map((_, joint) => shareOfLimit(state, joint)).filter(Number.isFinite);
  if (shares.length > 0) {
    const largest = Math.max(...shares);
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

// A figure with a name, a number and a line.
function makeCurve(section, name) {
  const figure = document.createElement('figure');
  const caption = document.createElement('figcaption');
  const label = document.createElement('span');
  label.textContent = name;
  const shown = document.createElement('span');
  caption.append(label, shown);
  const canvas = document.createElement('canvas');
  canvas.width = 460;
  canvas.height = name.startsWith('reward ') ? 48 : 96;
  figure.append(caption, canvas);
  section.append(figure);
  return { values: [], canvas, shown };
}

// Draws values over places from 0 to 1.
function plot({ values, canvas, shown }, places, shownValue, mark) {
  const known = values.filter(Number.isFinite);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const span = high - low || 1;
  const context = canvas.getContext('2d');
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.strokeStyle = '#ffd866';
  context.lineWidth = 2;
  context.beginPath();
  values.forEach((value, index) => {
    if (!Number.isFinite(value)) return;
    context.lineTo(places(index) * canvas.width, canvas.height - 6 - ((value - low) / span) * (canvas.height - 12));
  });
  context.stroke();
  if (mark !== null) {
    context.fillStyle = '#e8eaed';
    context.fillRect(mark * canvas.width - 1, 0, 2, canvas.height);
  }
  shown.textContent = Number.isFinite(shownValue) ? String(Number(shownValue.toPrecision(3))) : '–';
}

function addCurves(frame) {
  const ofRobot = frame.states[chosen]?.curves ?? [];
  const values = [...Object.entries(frame.curves), ...info.robot_curves.map((name, index) => [name, ofRobot[index]])];
  for (const [name, value] of values) {
    if (!curves.has(name)) {
      if (!Number.isFinite(value)) continue;
      curves.set(name, makeCurve($('curves'), name));
    }
    const curve = curves.get(name);
    curve.values.push(value ?? NaN);
    if (!recording && curve.values.length > CURVE_POINTS) curve.values.shift();
  }
}

// The last 20 s, or everything that was recorded with a line at the time that is shown.
function drawCurves() {
  const share = recording ? recording.time / (recording.duration || 1) : null;
  for (const curve of curves.values()) {
    const points = recording ? curve.values.length - 1 || 1 : CURVE_POINTS;
    const shown = curve.values[recording ? Math.round(share * points) : curve.values.length - 1];
    plot(curve, (index) => index / points, shown, share);
  }
}

// Follows a robot: its curves begin anew, those of all robots go on.
function follow(robot) {
  follows = true;
  if (robot === chosen) return;
  chosen = robot;
  for (const name of info.robot_curves) if (curves.has(name)) curves.get(name).values = [];
  if (recording) {
    curves.forEach((curve) => { curve.values = []; });
    recording.frames.forEach((frame) => addCurves(decode(frame)));
  }
}

// The learning curve since the beginning of the training, over environment steps.
const learning = { points: [], curves: null };

async function showLearning() {
  const query = `from=${learning.points.length}`;
  const response = await fetch(token ? `${url('learning')}&${query}` : `learning?${query}`);
  if (!response.ok) return;
  learning.points.push(...await response.json());
  const { points } = learning;
  if (points.length === 0) return;
  $('learning').hidden = false;
  learning.curves ??= [
    ['reward per step', (point) => point.reward],
    ['falls per minute and robot', (point) => point.falls_per_minute],
    ['velocity error [m/s]', (point) => point.velocity_error ?? NaN],
  ].map(([name, value]) => ({ value, curve: makeCurve($('learning'), name) }));
  const last = points[points.length - 1].env_steps;
  $('learning-steps').textContent = `${(last / 1e6).toFixed(1)} million steps`;
  for (const { value, curve } of learning.curves) {
    curve.values = points.map(value);
    plot(curve, (index) => points[index].env_steps / last, curve.values[points.length - 1], null);
  }
}

function resize() {
  const size = renderer.getSize(new Vector2());
  if (size.x !== innerWidth || size.y !== innerHeight) renderer.setSize(innerWidth, innerHeight, false);
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
    document.body.dataset.learningPoints = learning.points.length;
    if (drawn === 1) document.body.dataset.firstFrameMs = performance.now();
    document.body.dataset.frames = drawn;
  }
  // Without a frame there is nothing to see, and drawing it would delay the first one.
  if (drawn > 0) {
    orbit.update();
    renderer.render(scene, camera);
  }
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
  connectStick(([left, forward]) => {
    const part = ([low, high], share) => (share < 0 ? -share * low : share * high);
    sliders[0].value = part(info.velocity_bounds[0], forward);
    sliders[1].value = part(info.velocity_bounds[1], left);
    send();
  });
  $('push-help').hidden = !info.is_interactive;
  $('push').onclick = () => {
    const angle = 2 * Math.PI * Math.random();
    ask({ push: { robot: chosen, velocity: [Math.cos(angle), Math.sin(angle), 0] } });
  };
  $('reset').onclick = () => ask({ reset: null });
}

// A stick that springs back: how far to the left and forward it is held, from -1 to 1.
function connectStick(moved) {
  const stick = $('stick');
  stick.hidden = false;
  const show = (left, forward) => {
    $('knob').style.transform = `translate(${-left * 28}px, ${-forward * 28}px)`;
    moved([left, forward]);
  };
  const hold = (event) => {
    const box = stick.getBoundingClientRect();
    const radius = box.width / 2;
    const [x, y] = [(event.clientX - box.left) / radius - 1, (event.clientY - box.top) / radius - 1];
    const scale = Math.max(1, Math.hypot(x, y));
    show(-x / scale, -y / scale);
  };
  stick.onpointerdown = (event) => { stick.setPointerCapture(event.pointerId); hold(event); };
  stick.onpointermove = (event) => { if (stick.hasPointerCapture(event.pointerId)) hold(event); };
  stick.onlostpointercapture = () => show(0, 0);
}

function rayAt(event) {
  const ray = new Raycaster();
  ray.setFromCamera(new Vector2((2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight), camera);
  return ray;
}

function robotAt(event) {
  return rayAt(event).intersectObjects(robots.map((robot) => robot.root), true)[0]?.object.userData.robot;
}

// A push: dragged from a robot, it points from its trunk to the pointer.
let push = null;
const pushArrow = arrow(0xff6188);

function dragPush(event) {
  const trunk = robots[push.robot].bodies[0].getWorldPosition(new Vector3());
  const point = rayAt(event).ray.intersectPlane(new Plane(new Vector3(0, 0, 1), -trunk.z), new Vector3());
  const velocity = (point ? point.sub(trunk) : new Vector3()).multiplyScalar(PUSH_SCALE).clampLength(0, MAX_PUSH);
  showArrow(pushArrow, trunk, velocity.clone(), velocity.length() / PUSH_SCALE);
  $('status').textContent = `push: ${velocity.length().toFixed(1)} m/s`;
  push.velocity = [velocity.x, velocity.y, 0];
}

let pressed = [0, 0];
const canvas = renderer.domElement;
const isDragged = (event) => Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) >= 4;
// Before the camera turns.
canvas.addEventListener('pointerdown', (event) => {
  pressed = [event.clientX, event.clientY];
  const robot = info?.is_interactive && info.velocity_bounds ? robotAt(event) : undefined;
  if (robot === undefined) return;
  push = { robot, velocity: null };
  orbit.enabled = false;
  canvas.setPointerCapture(event.pointerId);
}, { capture: true });
canvas.addEventListener('pointermove', (event) => { if (push && isDragged(event)) dragPush(event); });
canvas.addEventListener('pointerup', (event) => {
  if (push?.velocity) ask({ push: { robot: push.robot, velocity: push.velocity } });
  if (!isDragged(event)) {
    const robot = robotAt(event);
    if (robot !== undefined) follow(robot);
  }
});
canvas.addEventListener('lostpointercapture', () => {
  [push, orbit.enabled, pushArrow.visible] = [null, true, false];
});
addEventListener('keydown', (event) => { if (event.key === 'f') follows = !follows; });
addEventListener('resize', resize);

// Reads the endless response, and keeps the newest frame.
async function read() {
  const response = await (framesAnswer ?? fetch(url('frames')));
  framesAnswer = null;
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
    const response = await sceneAnswer;
    if (!response.ok) { $('status').textContent = await response.text(); return; }
    info = await response.json();
  }
  // A server of another version may not have it.
  info.robot_curves ??= [];
  $('title').textContent = info.title;
  document.title = info.title;
  $('ghost-legend').hidden = !info.has_ghost;
  makeGround();
  connectControls();
  resize();
  animate();
  let [lastReceived, lastDrawn] = [0, 0];
  setInterval(() => {
    const status = received > lastReceived ? `${drawn - lastDrawn} frames/s` : 'waits for the next frame';
    if (received > 0 && !push) $('status').textContent = status;
    [lastReceived, lastDrawn] = [received, drawn];
    if (!recording) drawCurves();
  }, 1000);
  if (info.is_learning) {
    showLearning();
    setInterval(showLearning, 2000);
  }
  if (recording) play(); else connect();
}

start();
