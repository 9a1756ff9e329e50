// The WebSocket /live: connects when the page may ask, again when it is lost, and hands messages on by their kind.
const LONGEST_PAUSE = 8000;

export function watch(handlers, connected, admitted) {
  let pause = 500;
  async function connect() {
    await admitted();
    const socket = new WebSocket(new URL("live", location.href.replace(/^http/, "ws")));
    socket.onmessage = event => {
      const message = JSON.parse(event.data);
      pause = 500;
      if (handlers[message.kind]) handlers[message.kind](message, event.data.length);
    };
    socket.onopen = () => connected(true);
    socket.onclose = () => {
      connected(false);
      setTimeout(connect, pause);
      pause = Math.min(2 * pause, LONGEST_PAUSE);
    };
  }
  connect();
}
