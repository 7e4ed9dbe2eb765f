// The live stream of the daemon: reconnects by itself, and reports when the shown state is out of date.

const OFFLINE_MS = 1500; // states come every 100 ms
const RECONNECT_MS = 6000; // a connection without messages for this time is replaced
const RETRY_MS = [300, 600, 1200, 2500];

/**
 * Calls on.history(samples), on.state(state, sample) and on.event(event) for each message, and on.opened() and
 * on.offline() when the connection is opened or lost. A connection without messages counts as lost.
 */
export class LiveStream {
  constructor(on) {
    this.on = on;
    this.socket = null;
    this.tries = 0;
    this.receivedAt = -Infinity;
    this.openedAt = 0;
    this.newest_s = null;
    this.live = false;
    this.timer = 0;
    setInterval(() => this.check(), 250);
    window.addEventListener("online", () => this.reconnectNow());
    document.addEventListener("visibilitychange", () => this.reconnectNow());
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
      if (socket === this.socket) this.receive(JSON.parse(message.data));
    };
    socket.onclose = () => {
      if (socket === this.socket) this.reconnectLater();
    };
  }

  receive(message) {
    if (message.type === "history") this.on.history(message.samples);
    else if (message.type === "event") this.on.event(message.event);
    else if (message.type === "state") {
      if (message.sample.t_s === this.newest_s && this.newest_s !== null) return; // the control loop does not run
      this.newest_s = message.sample.t_s;
      this.receivedAt = performance.now();
      this.tries = 0;
      this.live = true;
      this.on.state(message.state, message.sample);
    }
  }

  reconnectLater() {
    this.socket = null;
    this.setOffline();
    const pause = RETRY_MS[Math.min(this.tries, RETRY_MS.length - 1)];
    this.tries += 1;
    this.timer = setTimeout(() => this.connect(), pause);
  }

  setOffline() {
    if (!this.live) return;
    this.live = false;
    this.on.offline();
  }

  check() {
    const now = performance.now();
    if (now - this.receivedAt > OFFLINE_MS) this.setOffline();
    if (this.socket && now - Math.max(this.receivedAt, this.openedAt) > RECONNECT_MS) {
      const dead = this.socket;
      this.reconnectLater();
      dead.close();
    }
  }

  /** Reconnect when the page is shown again or the network is back: the connection of a sleeping phone may be dead. */
  reconnectNow() {
    const old = this.socket;
    if (document.hidden || this.live || (old && performance.now() - this.openedAt < OFFLINE_MS)) return;
    this.connect();
    old?.close();
  }
}
