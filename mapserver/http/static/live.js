// The WebSocket /live: connects when the page may ask, again when it is lost, and hands messages on by their kind.
const LONGEST_PAUSE = 8000;
// ms without a message, after which the server is taken for gone: it says something every 10 s. A phone that has slept, or has
// changed its network, hears of no end of its connection.
export const limits = { silent: 25000 };

export function watch(handlers, connected, admitted) {
  let pause = 500, socket = null, silent = 0, again = 0;
  function heard() {
    clearTimeout(silent);
    silent = setTimeout(() => lost(""), limits.silent);
  }
  function lost(why) {
    clearTimeout(silent);
    // Closing takes long where no one answers.
    socket.onclose = socket.onmessage = socket.onopen = null;
    socket.close();
    socket = null;
    connected(false, why);
    again = setTimeout(connect, pause);
    pause = Math.min(2 * pause, LONGEST_PAUSE);
  }
  async function connect() {
    clearTimeout(again);
    again = 0;
    await admitted();
    socket = new WebSocket(new URL("live", location.href.replace(/^http/, "ws")));
    heard();
    socket.onmessage = event => {
      const message = JSON.parse(event.data);
      pause = 500;
      heard();
      if (handlers[message.kind]) handlers[message.kind](message, event.data.length);
    };
    socket.onopen = () => connected(true);
    // With a reason the server is there, and does not want more viewers.
    socket.onclose = ({ code, reason }) => lost(code === 1013 ? reason : "");
  }
  // A person who looks again does not wait for the rest of the pause.
  const hurry = () => { if (again && !document.hidden) connect(); };
  document.addEventListener("visibilitychange", hurry);
  addEventListener("online", hurry);
  connect();
}
