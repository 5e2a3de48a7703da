// A gamepad: its sticks move and turn the blade, one button cuts, another is the E-STOP.

const PERIOD_MS = 33;
const DEAD = 0.15; // share of a stick's way without effect
const SPEED = 0.05, RISE = 0.02; // [m/s] at the end of a stick's way
const TURN = 1.2; // [rad/s]
const CUT = 0, STOP = 1; // buttons of the standard mapping: the lower one, the right one

export class Gamepad {
  /** @param {function} guide returns the guide, or null @param {function} stop presses the E-STOP */
  constructor(guide, stop) {
    this._guide = guide;
    this._stop = stop;
    this._stopped = false;
    window.addEventListener('gamepadconnected', () => this._watch());
  }

  _watch() {
    if (this._timer !== undefined) return;
    this._timer = setInterval(() => this._read(), PERIOD_MS);
  }

  _read() {
    const pad = [...navigator.getGamepads()].find((one) => one?.connected);
    const guide = this._guide();
    if (!pad) {
      clearInterval(this._timer);
      this._timer = undefined;
      guide?.hold('pad', false);
      return;
    }
    const stopped = Boolean(pad.buttons[STOP]?.pressed);
    if (stopped && !this._stopped) this._stop();
    this._stopped = stopped;
    if (!guide?.allowed) return;
    guide.hold('pad', Boolean(pad.buttons[CUT]?.pressed));
    const [x, y, turn, rise] = [0, 1, 2, 3].map((axis) => bent(pad.axes[axis] ?? 0));
    const dt = PERIOD_MS / 1000;
    if (x) guide.shift('right', x * SPEED * dt);
    if (y) guide.shift('ahead', -y * SPEED * dt);
    if (rise) guide.shift('up', -rise * RISE * dt);
    if (turn) guide.turn('z', -turn * TURN * dt);
  }
}

/** A stick's way without its dead part, finer in the middle. */
function bent(value) {
  const way = Math.max(0, Math.abs(value) - DEAD) / (1 - DEAD);
  return Math.sign(value) * way * way;
}
