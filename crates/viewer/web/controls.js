// Buttons, sliders, the stick, and pushes of robots with the pointer.
import { Plane, Vector3 } from 'three';
import { showArrow } from 'twinstep/stage';

// Velocity that a push adds for each metre of its arrow [1/s], and the largest one [m/s].
const PUSH_SCALE = 3;
const MAX_PUSH = 3;

const $ = (id) => document.getElementById(id);

// One request at a time, so that the newest velocity arrives last.
let [wanted, isSteering] = [null, false];
async function steer(ask, velocity) {
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

export function showPlayback(playback, time) {
  if (!playback) return;
  isPaused = playback.is_paused;
  $('pause').textContent = isPaused ? 'play' : 'pause';
  if (playback.duration !== null) {
    $('seek').hidden = false;
    $('seek').max = playback.duration;
    if (!isSeeking) $('seek').value = time;
  }
}

// `ask` sends a request of the page; `followed` returns the robot that is followed.
export function connectControls(info, ask, followed) {
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
    steer(ask, sliders.map((slider) => Number(slider.value)));
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
    ask({ push: { robot: followed(), velocity: [Math.cos(angle), Math.sin(angle), 0] } });
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

// A click on a robot calls `follow`. Where robots may be pushed, an arrow dragged from one pushes it.
export function connectPointer(stage, { mayPush, ask, follow }) {
  const canvas = stage.renderer.domElement;
  const pushArrow = stage.arrow(0xe03131);
  let [push, pressed] = [null, [0, 0]];
  const isDragged = (event) => Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) >= 4;
  // Before the camera turns.
  canvas.addEventListener('pointerdown', (event) => {
    pressed = [event.clientX, event.clientY];
    const robot = mayPush ? stage.robotAt(event) : undefined;
    if (robot === undefined) return;
    push = { robot, velocity: null };
    stage.orbit.enabled = false;
    canvas.setPointerCapture(event.pointerId);
  }, { capture: true });
  canvas.addEventListener('pointermove', (event) => {
    if (!push || !isDragged(event)) return;
    const trunk = stage.trunkOf(push.robot);
    const point = stage.rayAt(event).ray.intersectPlane(new Plane(new Vector3(0, 0, 1), -trunk.z), new Vector3());
    const velocity = (point ? point.sub(trunk) : new Vector3()).multiplyScalar(PUSH_SCALE).clampLength(0, MAX_PUSH);
    showArrow(pushArrow, trunk, velocity.clone(), velocity.length() / PUSH_SCALE);
    $('push-size').textContent = ` · push: ${velocity.length().toFixed(1)} m/s`;
    push.velocity = [velocity.x, velocity.y, 0];
  });
  canvas.addEventListener('pointerup', (event) => {
    if (push?.velocity) ask({ push: { robot: push.robot, velocity: push.velocity } });
    if (!isDragged(event)) {
      const robot = stage.robotAt(event);
      if (robot !== undefined) follow(robot);
    }
  });
  canvas.addEventListener('lostpointercapture', () => {
    [push, stage.orbit.enabled, pushArrow.visible] = [null, true, false];
    $('push-size').textContent = '';
  });
}
