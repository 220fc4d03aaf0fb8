// The page: reads frames, draws the robots of the newest one, shows their numbers, and sends the requests of its controls.
import { connectControls, connectPointer, showPlayback } from 'twinstep/controls';
import { Curves, samples } from 'twinstep/curves';
import { Recording } from 'twinstep/recording';
import { Stage, shareOfLimit } from 'twinstep/stage';

const MAX_ROBOTS = 64;
// Time between two drawings of the curves of a program [ms].
const CURVES_PERIOD = 250;

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

const stage = new Stage($('scene'));
const curves = new Curves($('curves'), {
  isEndless: !recording, seek: recording && ((time) => ask({ seek: time - recording.times[0] })),
});
let info;
let chosen = 0;
let follows = true;
let newest = null;
let received = 0;
let drawn = 0;

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

function vector(values) {
  return [...values].map((value) => (Number.isFinite(value) ? value.toFixed(2) : '–')).join(' ');
}

function showFacts(frame) {
  const state = frame.states[chosen] ?? frame.states[0];
  if (!state) return;
  const rows = [['robot', `${chosen + 1} of ${frame.robots}`], ['time', `${frame.time.toFixed(2)} s`]];
  if (Number.isFinite(state.command[0])) rows.push(['commanded', vector(state.command)]);
  if (Number.isFinite(state.velocity[0])) rows.push(['velocity', vector(state.velocity)]);
  const shares = info.joints.map((_, joint) => shareOfLimit(info, state, joint));
  const largest = Math.max(...shares.filter(Number.isFinite));
  if (largest > 0) rows.push(['largest torque', `${(100 * largest).toFixed(0)} % at ${info.joints[shares.indexOf(largest)]}`]);
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

// Follows a robot: its curves begin anew.
function follow(robot) {
  follows = true;
  if (robot === chosen) return;
  chosen = robot;
  curves.clear();
  recording?.frames.map(decode).forEach((frame) => curves.add(frame.time, samples(info, frame, chosen)));
}

// The learning curve since the beginning of the training, over millions of environment steps.
const learning = { from: 0, curves: null };

async function showLearning() {
  const query = `from=${learning.from}`;
  const response = await fetch(token ? `${url('learning')}&${query}` : `learning?${query}`);
  if (!response.ok) return;
  const points = await response.json();
  if (points.length === 0) return;
  learning.from += points.length;
  $('learning').hidden = false;
  learning.curves ??= new Curves($('learning-curves'), { isEndless: false, unit: 'M steps' });
  for (const point of points) {
    learning.curves.add(point.env_steps / 1e6, [
      ['learning curve', 'reward per step', '', point.reward],
      ['learning curve', 'falls per minute and robot', '', point.falls_per_minute],
      ['learning curve', 'velocity error [m/s]', '', point.velocity_error ?? NaN],
    ]);
  }
  const last = points[points.length - 1].env_steps / 1e6;
  $('learning-steps').textContent = `${last.toFixed(1)} million steps`;
  learning.curves.draw(last);
}

function animate() {
  if (newest) {
    chosen = Math.min(chosen, newest.robots - 1);
    stage.draw(newest, follows ? chosen : null);
    showFacts(newest);
    showPlayback(newest.playback, newest.time);
    newest = null;
    drawn += 1;
    document.body.dataset.learningPoints = learning.from;
    if (drawn === 1) document.body.dataset.firstFrameMs = performance.now();
    document.body.dataset.frames = drawn;
  }
  // Without a frame there is nothing to see, and drawing it would delay the first one.
  if (drawn > 0) stage.render();
  requestAnimationFrame(animate);
}

async function ask(request) {
  if (recording) { recording.obey(request); return; }
  await fetch(url('request'), {
    method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify(request),
  });
}

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
      curves.add(newest.time, samples(info, newest, chosen));
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
  recording.frames.map(decode).forEach((frame) => curves.add(frame.time, samples(info, frame, chosen)));
  for (;;) {
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    const payload = recording.advance((now - last) / 1000);
    last = now;
    newest = decode(payload);
    newest.playback = recording.playback;
    received += 1;
    curves.draw(newest.time);
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
  stage.begin(info);
  connectControls(info, ask, () => chosen);
  connectPointer(stage, { mayPush: info.is_interactive && info.velocity_bounds, ask, follow });
  addEventListener('keydown', (event) => { if (event.key === 'f') follows = !follows; });
  addEventListener('resize', () => { stage.resize(); curves.draw(); });
  animate();
  let [lastReceived, lastDrawn] = [0, 0];
  setInterval(() => {
    const waiting = recording ? 'recorded motion' : 'waits for the next frame';
    const status = received > lastReceived && !recording?.isPaused ? `${drawn - lastDrawn} frames/s` : waiting;
    if (received > 0) $('status').textContent = status;
    [lastReceived, lastDrawn] = [received, drawn];
  }, 1000);
  if (!recording) setInterval(() => curves.draw(), CURVES_PERIOD);
  if (info.is_learning) {
    showLearning();
    setInterval(showLearning, 2000);
  }
  if (recording) play(); else connect();
}

start();
