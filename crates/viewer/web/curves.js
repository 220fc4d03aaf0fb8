// Curves beside the scene: groups of plots over one time axis, with one cursor for all of them.

// Samples that a page keeps of a program without an end: 20 s of 30 a second.
const MAX_SAMPLES = 600;
const COLOURS = ['#1473e6', '#e8590c', '#2b8a3e', '#9c36b5', '#0b7285', '#c2255c', '#5c940d', '#364fc7'];
const REFERENCE = '#f0a000';
// Space for the numbers of the axes [px].
const LEFT = 44;
const TICKS = 14;

function short(value) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(3))) : '–';
}

// Values of a frame as [group, plot, line, value]. A line without a name is the only one of its plot.
export function samples(info, frame, followed) {
  const state = frame.states[followed];
  const values = [];
  if (state) {
    ['forward [m/s]', 'left [m/s]', 'turn [rad/s]'].forEach((plot, axis) => {
      values.push(['velocity', plot, 'command', state.command[axis]], ['velocity', plot, 'robot', state.velocity[axis]]);
    });
    info.contacts.forEach((contact, index) => values.push(['feet', 'force of the ground', contact.name, state.force[index]]));
  }
  const named = [...Object.entries(frame.curves), ...info.robot_curves.map((name, index) => [name, state?.curves[index]])];
  for (const [name, value] of named) {
    if (name.startsWith('reward ')) values.push(['reward per step', name.slice('reward '.length), '', value]);
    else if (name.endsWith('error [rad]')) values.push(['simulated minus measured position', name, '', value]);
    else values.push(['others', name, '', value]);
  }
  return values;
}

export class Curves {
  // `root`: element of the groups. `isEndless`: only the last samples are kept, on an axis of 20 s. `unit`: of the axis.
  // `seek`: called with the time at which somebody clicks.
  constructor(root, { isEndless, unit = 's', seek = null }) {
    Object.assign(this, { root, seek, unit, isEndless, times: [], groups: new Map(), cursor: null });
    root.addEventListener('pointermove', (event) => this.#point(event));
    root.addEventListener('pointerleave', () => { this.cursor = null; this.draw(); });
    root.addEventListener('pointerdown', (event) => {
      if (this.seek && event.target.tagName === 'CANVAS') this.seek(this.#timeAt(event));
    });
  }

  add(time, values) {
    // Time that goes back is a new motion.
    if (time < this.times[this.times.length - 1]) this.clear();
    this.times.push(time);
    const isFull = this.isEndless && this.times.length > MAX_SAMPLES;
    if (isFull) this.times.shift();
    for (const [group, plot, line, value] of values) {
      const known = this.groups.get(group)?.plots.get(plot)?.lines.get(line);
      if (known) known.push(value ?? NaN);
      else if (Number.isFinite(value)) this.#line(group, plot, line).push(value);
    }
    for (const lines of this.#allLines()) {
      while (lines.length < this.times.length) lines.push(NaN);
      while (lines.length > this.times.length) lines.shift();
    }
  }

  clear() {
    this.times = [];
    for (const lines of this.#allLines()) lines.length = 0;
  }

  // Draws all plots, with a line at `time` unless the pointer has put it elsewhere.
  draw(time = null) {
    if (time !== null) this.playing = time;
    const last = this.times.length - 1;
    const wanted = this.cursor ?? this.playing;
    const index = wanted === undefined ? last : Math.max(this.times.findLastIndex((each) => each <= wanted + 1e-6), 0);
    for (const [name, { element, plots }] of this.groups) {
      if (!element.open) continue;
      const shown = [...plots.values()];
      shown.forEach((plot, at) => this.#draw(name, plot, index, at === shown.length - 1));
    }
  }

  // From the first to the last time of the axis [s].
  #range() {
    const last = this.times[this.times.length - 1] ?? 0;
    const first = this.times[0] ?? 0;
    return this.isEndless ? [Math.min(first, last - 20), last] : [first, last];
  }

  *#allLines() {
    for (const { plots } of this.groups.values()) for (const { lines } of plots.values()) yield* lines.values();
  }

  #timeAt(event) {
    const box = event.target.getBoundingClientRect();
    const share = Math.min(Math.max((event.clientX - box.left - LEFT) / (box.width - LEFT), 0), 1);
    const [from, to] = this.#range();
    return from + share * (to - from);
  }

  #point(event) {
    this.cursor = event.target.tagName === 'CANVAS' ? this.#timeAt(event) : null;
    this.draw();
  }

  // Returns the numbers of a line, which it makes if it is new.
  #line(groupName, plotName, lineName) {
    if (!this.groups.has(groupName)) {
      const element = document.createElement('details');
      element.open = groupName !== 'reward per step';
      element.append(document.createElement('summary'));
      element.firstChild.textContent = groupName;
      element.ontoggle = () => this.draw();
      this.root.append(element);
      this.groups.set(groupName, { element, plots: new Map() });
    }
    const group = this.groups.get(groupName);
    if (!group.plots.has(plotName)) {
      const figure = document.createElement('figure');
      const caption = document.createElement('figcaption');
      caption.textContent = plotName;
      const canvas = document.createElement('canvas');
      figure.append(caption, canvas);
      group.element.append(figure);
      group.plots.set(plotName, { name: plotName, caption, canvas, lines: new Map() });
    }
    const { lines } = group.plots.get(plotName);
    lines.set(lineName, Array(this.times.length - 1).fill(NaN));
    return lines.get(lineName);
  }

  #draw(group, plot, index, hasTicks) {
    const lines = [...plot.lines];
    const isStrip = group === 'feet';
    const hasCommand = plot.lines.has('command');
    const colour = (at) => (hasCommand ? [REFERENCE, COLOURS[0]][at] : COLOURS[at % COLOURS.length]);
    const label = document.createElement('span');
    label.textContent = plot.name;
    const numbers = lines.map(([name, values], at) => {
      const number = document.createElement('b');
      if (!isStrip) number.style.color = colour(at);
      number.textContent = short(values[index]);
      number.title = name;
      return number;
    });
    plot.caption.replaceChildren(label, ...(isStrip ? [] : numbers));
    const height = (isStrip ? 9 * lines.length + 4 : 44) + (hasTicks ? TICKS : 0);
    const context = this.#context(plot.canvas, height);
    const width = plot.canvas.clientWidth;
    const [from, to] = this.#range();
    const x = (time) => LEFT + ((time - from) / (to - from || 1)) * (width - LEFT);
    const area = { context, x, width, bottom: height - (hasTicks ? TICKS : 0) };
    if (isStrip) this.#drawStrips(area, lines);
    else this.#drawLines(area, lines, colour);
    if (hasTicks) this.#drawTicks(area, from, to);
    if (index >= 0 && (this.cursor !== null || !this.isEndless)) {
      context.fillStyle = '#20242b99';
      context.fillRect(x(this.times[index]) - 0.5, 0, 1, area.bottom);
    }
  }

  #context(canvas, height) {
    const scale = Math.min(devicePixelRatio, 2);
    canvas.style.height = `${height}px`;
    [canvas.width, canvas.height] = [Math.round(canvas.clientWidth * scale), Math.round(height * scale)];
    const context = canvas.getContext('2d');
    context.scale(scale, scale);
    context.font = '10px system-ui, sans-serif';
    return context;
  }

  #drawLines({ context, x, width, bottom }, lines, colour) {
    let [low, high] = [Infinity, -Infinity];
    for (const [, values] of lines) {
      for (const value of values) if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) return;
    const ticks = high > low ? [low, high] : [low];
    // A line that hardly changes is flat, not noise that fills the plot.
    const least = 1e-3 * Math.max(Math.abs(low), Math.abs(high), 1e-3);
    if (high - low < least) [low, high] = [low - least, high + least];
    const y = (value) => bottom - 4 - ((value - low) / (high - low)) * (bottom - 8);
    context.fillStyle = '#f4f6f8';
    context.fillRect(LEFT, 0, width - LEFT, bottom);
    if (low < 0 && high > 0) {
      context.fillStyle = '#c3cad3';
      context.fillRect(LEFT, y(0), width - LEFT, 1);
    }
    context.fillStyle = '#5c6670';
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    for (const value of ticks) context.fillText(short(value), LEFT - 4, Math.min(Math.max(y(value), 5), bottom - 5));
    context.lineWidth = 1.4;
    lines.forEach(([, values], at) => {
      context.strokeStyle = colour(at);
      context.beginPath();
      let isDrawing = false;
      values.forEach((value, index) => {
        const point = [x(this.times[index]), y(value)];
        if (Number.isFinite(value)) context[isDrawing ? 'lineTo' : 'moveTo'](...point);
        isDrawing = Number.isFinite(value);
      });
      context.stroke();
    });
  }

  // A bar for each foot while it stands, darker for more force.
  #drawStrips({ context, x, width }, lines) {
    const largest = Math.max(...lines.flatMap(([, values]) => values.filter(Number.isFinite)), 1);
    lines.forEach(([name, values], row) => {
      const top = 2 + 9 * row;
      context.fillStyle = '#f4f6f8';
      context.fillRect(LEFT, top, width - LEFT, 8);
      context.fillStyle = '#5c6670';
      context.textAlign = 'right';
      context.textBaseline = 'middle';
      context.fillText(name.slice(0, 8), LEFT - 4, top + 4);
      values.forEach((value, index) => {
        if (!(value > 0) || index === 0) return;
        context.fillStyle = `rgba(31, 157, 85, ${0.3 + 0.7 * Math.min(value / largest, 1)})`;
        const from = x(this.times[index - 1]);
        context.fillRect(from, top, x(this.times[index]) - from + 0.3, 8);
      });
    });
  }

  #drawTicks({ context, x, bottom }, from, to) {
    context.fillStyle = '#5c6670';
    context.textBaseline = 'bottom';
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 300].find((each) => (to - from) / each <= 5) ?? (to - from) / 4;
    for (let at = Math.ceil(from / step) * step; at <= to; at += step) {
      if (at < 0) continue;
      const place = x(at);
      context.fillRect(place - 0.5, bottom, 1, 3);
      context.textAlign = place > x(to) - 12 ? 'right' : place < LEFT + 12 ? 'left' : 'center';
      context.fillText(`${short(at)} ${this.unit}`, place, bottom + TICKS);
    }
  }
}
