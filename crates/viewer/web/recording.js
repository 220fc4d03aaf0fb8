// Plays the frames that are part of the page, in place of a program that sends them.
export class Recording {
  // `frames`: frames in base64, one after another, as a program sends them.
  constructor(frames) {
    const bytes = Uint8Array.from(atob(frames), (character) => character.charCodeAt(0));
    this.frames = [];
    for (let at = 0; at + 8 <= bytes.length;) {
      const length = new DataView(bytes.buffer, at).getUint32(0, true);
      this.frames.push(bytes.subarray(at + 4, at + 8 + length));
      at += 8 + length;
    }
    this.times = this.frames.map((frame) => {
      const length = new DataView(frame.buffer, frame.byteOffset).getUint32(0, true);
      return JSON.parse(new TextDecoder().decode(frame.subarray(4, 4 + length))).time;
    });
    this.time = 0;
    this.duration = this.times[this.times.length - 1] - this.times[0];
    this.speed = 1;
    this.isPaused = false;
  }

  obey(request) {
    if ('pause' in request) {
      if (!request.pause && this.time >= this.duration) this.time = 0;
      this.isPaused = request.pause;
    }
    if ('speed' in request) this.speed = request.speed;
    if ('seek' in request) this.time = Math.min(Math.max(request.seek, 0), this.duration);
  }

  // Advances by `elapsed` seconds, and returns the payload of the frame to show.
  advance(elapsed) {
    if (!this.isPaused) this.time = Math.min(this.time + this.speed * elapsed, this.duration);
    if (this.time >= this.duration) this.isPaused = true;
    const next = this.times.findIndex((time) => time > this.times[0] + this.time + 1e-6);
    return this.frames[(next < 0 ? this.frames.length : Math.max(next, 1)) - 1];
  }

  get playback() {
    return { duration: this.duration, is_paused: this.isPaused, speed: this.speed };
  }
}
