// The E-STOP: sent when it is pressed, and again until the server confirms it.

const AGAIN_MS = 300;
const DOUBT_MS = 900;
const REMIND_MS = 5000;

export class Stop {
  /**
   * @param {HTMLElement} button
   * @param {HTMLElement} reset
   * @param {object} connection
   * @param {function} warn takes a sentence
   */
  constructor(button, reset, connection, warn) {
    this._button = button;
    this._reset = reset;
    this._connection = connection;
    this._warn = warn;
    this.active = false;
    this.holds = false;
    this.wanted = false; // pressed, and not confirmed since then
    connection.opened = () => this._send();
    button.addEventListener('pointerdown', (event) => {
      if (event.button === 0) this.press();
    });
    button.addEventListener('click', (event) => {
      if (event.detail === 0) this.press(); // by Enter, or by an assistive device
    });
    reset.addEventListener('click', () => connection.send({ op: 'reset_e_stop' }));
    // Handled before all other keys, whatever has the focus.
    window.addEventListener('keydown', (event) => this._key(event), { capture: true });
    window.addEventListener('keyup', (event) => this._key(event, false), { capture: true });
  }

  _key(event, down = true) {
    if (!this.active || (event.code !== 'Space' && event.key !== 'Escape')) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (down && !event.repeat) this.press();
  }

  press() {
    this.wanted = true;
    this._sent = true;
    this._warnAt = performance.now() + DOUBT_MS;
    this._send();
  }

  /** Applies the server's E-STOP state. Nothing else ends the sending. */
  show(holds) {
    this.holds = holds;
    if (holds) this.wanted = false;
    this._reset.hidden = !holds;
    this._button.setAttribute('aria-pressed', String(holds));
  }

  _send() {
    clearTimeout(this._timer);
    if (!this.wanted) return;
    const sent = this._connection.send({ op: 'e_stop' });
    const now = performance.now();
    if (this._sent && !sent) this._warnAt = now;
    this._sent = sent;
    if (now >= this._warnAt) {
      this._warnAt = now + REMIND_MS;
      if (sent) this._warn('E-STOP is not confirmed yet. Use the wired stop.');
      else this._warn('E-STOP NOT SENT: there is no connection. Use the wired stop. It is sent as soon as the connection is back.');
    }
    this._timer = setTimeout(() => this._send(), AGAIN_MS);
  }
}
