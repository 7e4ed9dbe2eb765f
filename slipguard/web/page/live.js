// The daemon's live stream: connects by itself again, and says when what is shown is no longer so.

const SILENT_MS = 1500; // states come every 100 ms
const DEAD_MS = 6000; // a connection that gives nothing for so long is given up
const PAUSES_MS = [300, 600, 1200, 2500];

/**
 * Calls on.history(samples), on.state(state, sample), on.event(event) as they come, and on.lost() and on.opened()
 * when the connection goes and comes. A connection that gives nothing counts as gone.
 */
export class Live {
  constructor(on) {
    this.on = on;
    this.socket = null;
    this.tries = 0;
    this.heardAt = -Infinity;
    this.openedAt = 0;
    this.toldOf_s = null;
    this.live = false;
    this.timer = 0;
    setInterval(() => this.look(), 250);
    for (const name of ["online", "visibilitychange"]) {
      (name === "online" ? window : document).addEventListener(name, () => this.hurry());
    }
    this.connect();
  }

  connect() {
    clearTimeout(this.timer);
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/live`);
    this.socket = socket;
    this.openedAt = performance.now();
    socket.onopen = () => {
      if (socket === this.socket) this.on.opened();
    };
    socket.onmessage = (message) => {
      if (socket === this.socket) this.take(JSON.parse(message.data));
    };
    socket.onclose = () => {
      if (socket === this.socket) this.again();
    };
  }

  take(message) {
    if (message.type === "history") this.on.history(message.samples);
    else if (message.type === "event") this.on.event(message.event);
    else if (message.type === "state") {
      if (message.sample.t_s === this.toldOf_s && this.toldOf_s !== null) return; // the loop stands still
      this.toldOf_s = message.sample.t_s;
      this.heardAt = performance.now();
      this.tries = 0;
      this.live = true;
      this.on.state(message.state, message.sample);
    }
  }

  again() {
    this.socket = null;
    this.lose();
    const pause = PAUSES_MS[Math.min(this.tries, PAUSES_MS.length - 1)];
    this.tries += 1;
    this.timer = setTimeout(() => this.connect(), pause);
  }

  lose() {
    if (!this.live) return;
    this.live = false;
    this.on.lost();
  }

  look() {
    const now = performance.now();
    if (now - this.heardAt > SILENT_MS) this.lose();
    if (this.socket && now - Math.max(this.heardAt, this.openedAt) > DEAD_MS) {
      const dead = this.socket;
      this.again();
      dead.close();
    }
  }

  /** Somebody looks again, or the network is back: a telephone asleep may hold a connection that is long dead. */
  hurry() {
    const old = this.socket;
    if (document.hidden || this.live || (old && performance.now() - this.openedAt < SILENT_MS)) return;
    this.connect();
    old?.close();
  }
}
