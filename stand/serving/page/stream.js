// The stand's stream: connects, and again whenever it is lost, from the last number it has seen.
const SILENT_MS = 6000; // the state comes twice a second
const SOONEST_MS = 400, LATEST_MS = 4000;

export function follow(handlers) {
  let seq = null, socket = null, heard_ms = 0, wait_ms = SOONEST_MS, is_lost = true;

  function lost() {
    if (!is_lost) { is_lost = true; handlers.lost(); }
  }

  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const from = seq === null ? "" : `?from=${seq}`;
    socket = new WebSocket(`${scheme}://${location.host}/api/v1/stream${from}`);
    heard_ms = performance.now();
    socket.onmessage = (message) => {
      heard_ms = performance.now();
      wait_ms = SOONEST_MS;
      const { seq: number, type, data } = JSON.parse(message.data);
      seq = Math.max(seq ?? 0, number);
      if (is_lost) { is_lost = false; handlers.back(); }
      handlers[type]?.(data, number);
    };
    socket.onclose = () => {
      lost();
      setTimeout(connect, wait_ms);
      wait_ms = Math.min(LATEST_MS, wait_ms * 1.7);
    };
  }

  // A network that is cut closes nothing.
  setInterval(() => {
    if (performance.now() - heard_ms > SILENT_MS && socket.readyState <= 1) { lost(); socket.close(); }
  }, 1000);
  connect();
}
