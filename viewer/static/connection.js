// WebSocket to the server: reconnects by itself, and reports the age of the newest message.

const PING_MS = 500;
const STALE_MS = 1000;
const DEAD_MS = 5000;
const MIN_WAIT_MS = 400;
const MAX_WAIT_MS = 3000;
const REFUSALS = 3;
const OLD_LINK =
  'There is no connection. The picture is old. If the trainer was started anew, this link is an old one: open the one that it printed.';

/** Address of the socket: beside the page, with the page's token. */
function address(path) {
  const url = new URL(path, location.href);
  url.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
  const token = new URLSearchParams(location.search).get('token');
  url.search = token === null ? '' : `?${new URLSearchParams({ token })}`;
  url.hash = '';
  return url.href;
}

export class Connection {
  /**
   * @param {object} take handlers of a message: text(object), binary(ArrayBuffer)
   * @param {function} changed called after each change of `status` or `age`
   * @param {string} path of the socket, beside the page
   */
  constructor(take, changed, path) {
    this._path = path;
    this.status = 'connecting';
    this.reason = '';
    this.stale = false;
    this.age = 0;
    this.delay = null;
    this.expects = true; // messages all the time; a paused recorded session sends none
    this._take = take;
    this._changed = changed;
    this._wait = MIN_WAIT_MS;
    this._refusals = 0; // sockets since the last one that opened
    this.opened = () => {}; // called first when a socket opens
    this._tellsAge = false;
    this._pings = new Map();
    this._ping = 0;
    setInterval(() => this._watch(), 250);
    setInterval(() => this._sendPing(), PING_MS);
    window.addEventListener('online', () => this._retryNow());
  }

  open() {
    this._timer = null;
    this._heard = this._news = performance.now();
    const socket = new WebSocket(address(this._path));
    socket.binaryType = 'arraybuffer';
    this._socket = socket;
    socket.onopen = () => {
      if (socket !== this._socket) return;
      this._wait = MIN_WAIT_MS;
      this._refusals = 0;
      this._heard = this._news = performance.now();
      this.opened();
      this._become('open', '');
    };
    socket.onmessage = (event) => this._hear(event.data);
    socket.onclose = () => {
      if (socket !== this._socket) return;
      // A browser gives no reason for a rejected handshake: an old token is one of many.
      if (this.status !== 'open') this._refusals += 1;
      this._lose();
    };
  }

  /** Sends one message; returns whether there is a connection. */
  send(message) {
    if (this._socket?.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify(message));
    return true;
  }

  _lose() {
    this._socket = null;
    this._become('lost', this._refusals >= REFUSALS ? OLD_LINK : '');
    this._timer = setTimeout(() => this.open(), this._wait);
    this._wait = Math.min(1.6 * this._wait, MAX_WAIT_MS);
  }

  _hear(data) {
    const now = performance.now();
    this._heard = now;
    if (typeof data !== 'string') {
      if (!this._tellsAge) this._news = now;
      this._take.binary(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.type === 'pong') {
      this.delay = now - (this._pings.get(message.id) ?? now);
      this._pings.clear();
      // Age of the server's own data; an older server shows it by its silence.
      if (Number.isFinite(message.age)) this._news = now - 1000 * message.age;
      this._tellsAge = Number.isFinite(message.age);
      return;
    }
    if (!this._tellsAge) this._news = now;
    this._take.text(message);
  }

  _watch() {
    const now = performance.now();
    const socket = this._socket;
    if (!socket) return;
    // A socket that does not open counts as dead, as a silent one does.
    if (now - this._heard > DEAD_MS) {
      socket.onmessage = null;
      this._lose();
      socket.close();
      return;
    }
    if (this.status !== 'open') return;
    this.age = now - this._news;
    if (!this.expects && !this._tellsAge) this.age = now - this._heard;
    this.stale = this.age > STALE_MS;
    this._changed();
  }

  _sendPing() {
    if (this.status !== 'open') return;
    this._ping += 1;
    this._pings.set(this._ping, performance.now());
    this.send({ op: 'ping', id: this._ping });
  }

  _retryNow() {
    if (this._timer === null) return;
    clearTimeout(this._timer);
    this.open();
  }

  _become(status, reason) {
    this.status = status;
    this.reason = reason;
    this.stale = false;
    this._changed();
  }
}
