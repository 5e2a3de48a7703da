// A page's connection and E-STOP with a network and a clock that are none; prints what came of it.
// Usage: node page_socket.mjs CASE, beside copies of connection.js and stop.js that end in .mjs.

let now = 0;
let timers = [];
const every = (job, wait, again) => timers.push({ job, at: now + wait, again: again && wait }) && timers.at(-1);
globalThis.setTimeout = (job, wait) => every(job, wait, 0);
globalThis.setInterval = (job, wait) => every(job, wait, 1);
globalThis.clearTimeout = (timer) => (timers = timers.filter((one) => one !== timer));
Object.defineProperty(globalThis, 'performance', { value: { now: () => now } });
globalThis.window = { addEventListener() {} };
globalThis.location = { href: 'http://127.0.0.1:8080/?token=x', protocol: 'http:', search: '?token=x' };

function pass(ms) {
  const end = now + ms;
  for (;;) {
    const next = timers.filter((one) => one.at <= end).sort((a, b) => a.at - b.at)[0];
    if (!next) break;
    now = next.at;
    if (next.again) next.at += next.again;
    else clearTimeout(next);
    next.job();
  }
  now = end;
}

const sockets = [];
globalThis.WebSocket = class {
  static CONNECTING = 0;
  static OPEN = 1;
  constructor() {
    this.readyState = 0;
    this.sent = [];
    sockets.push(this);
  }
  send(text) {
    this.sent.push(JSON.parse(text).op);
  }
  close() {
    this.readyState = 2; // a dead network answers nothing
  }
  opens() {
    this.readyState = 1;
    this.onopen();
  }
  ends() {
    this.readyState = 3;
    this.onclose({ code: 1006 });
  }
  says(holds) {
    this.onmessage?.({ data: JSON.stringify({ type: 'state', e_stopped: holds }) });
  }
  get stops() {
    return this.sent.filter((op) => op === 'e_stop').length;
  }
};

const { Connection } = await import('./connection.mjs');
const { Stop } = await import('./stop.mjs');
const element = () => ({ addEventListener() {}, setAttribute() {} });
const warnings = [];
let stop = null;
const connection = new Connection({ text: (message) => stop.show(message.e_stopped) }, () => {}, 'session');
stop = new Stop(element(), element(), connection, (text) => warnings.push(text));
connection.open();

const cases = {
  silence() { // the network takes everything and says nothing
    sockets[0].opens();
    stop.press();
    pass(4900);
    const into = sockets[0].stops;
    pass(1000);
    sockets[1].opens();
    const first = sockets[1].sent[0];
    sockets[1].says(false);
    pass(3000);
    const again = sockets[1].stops;
    sockets[1].says(true);
    pass(3000);
    return { into, first, again, after: sockets[1].stops - again, warnings };
  },
  restart() { // the server opens, but its bridge is not there yet; then it is reset
    stop.press();
    sockets[0].opens();
    for (let i = 0; i < 20; i += 1) {
      pass(1000);
      sockets[0].says(false);
    }
    const unheard = sockets[0].stops;
    sockets[0].says(true);
    sockets[0].says(false);
    pass(2000);
    return { unheard, reset: sockets[0].stops - unheard, warnings };
  },
  held() { // pressed while one holds: only what comes after the press counts
    sockets[0].opens();
    sockets[0].says(true);
    stop.press();
    pass(1000);
    const unheard = sockets[0].stops;
    sockets[0].says(true);
    sockets[0].says(false);
    pass(1000);
    return { unheard, reset: sockets[0].stops - unheard };
  },
  connecting() { // a handshake without an answer
    pass(6000);
    const [first, second] = sockets;
    second?.opens();
    return { sockets: sockets.length, closed: first.readyState, status: connection.status };
  },
  refused() { // each handshake gets a 403
    const said = [];
    for (let i = 0; i < 4; i += 1) {
      sockets.at(-1).ends();
      said.push(connection.reason);
      pass(3000);
    }
    sockets.at(-1).opens();
    return { said, at_last: connection.reason };
  },
};
process.stdout.write(JSON.stringify(cases[process.argv[2]]()));
process.exit(0);
