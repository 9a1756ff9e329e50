// Who is logged in, on a fleet with keys: GET session, POST login and logout.
import { ask, byId } from "./dom.js";
import { limits } from "./live.js";

let shown = false, asking = null; // whether anything of the fleet is shown; a question on its way

// Wait until this page may ask: at once without keys, else once a person has logged in.
export const admitted = () => asking ??= check().finally(() => { asking = null; });

async function check() {
  for (;;) {
    // A question to a network that says nothing has no end by itself.
    const answer = await ask("session", { signal: AbortSignal.timeout(limits.silent) });
    if (answer.status !== 401) {
      shown ||= !answer.error;
      byId("who").textContent = answer.name ? `${answer.name}, ${answer.role}` : "";
      byId("logout").hidden = !answer.name;
      return;
    }
    // What is shown was for who was logged in.
    if (shown) { location.reload(); await new Promise(() => {}); }
    await loggedIn();
  }
}
// The form, until a token is taken.
function loggedIn() {
  const form = byId("login"), token = byId("token"), words = byId("login-words");
  form.hidden = false;
  document.body.className = "locked";
  token.focus();
  return new Promise(done => {
    form.onsubmit = async event => {
      event.preventDefault();
      const body = JSON.stringify({ token: token.value.trim() }), headers = { "Content-Type": "application/json" };
      const answer = await ask("login", { method: "POST", headers, body });
      words.textContent = answer.error || "";
      if (answer.error) return;
      token.value = "";
      form.hidden = true;
      document.body.className = "";
      done();
    };
  });
}
byId("logout").addEventListener("click", async () => {
  await ask("logout", { method: "POST" });
  location.reload();
});
