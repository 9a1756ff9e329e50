"use strict";
const byId = id => document.getElementById(id), result = byId("result");
const cell = text => { const td = document.createElement("td"); td.textContent = text; return td; };
function say(text, kind) { result.className = kind; result.textContent = text; }
function table(candidates) {
  const table = document.createElement("table"), head = table.insertRow();
  for (const name of ["place", "ahead", "left", "turned", "probability"]) {
    const th = document.createElement("th"); th.textContent = name; head.append(th);
  }
  for (const c of candidates) {
    const [x, y, turn] = c.node_from_robot.mean;
    const away = m => cell(c.distance_known ? m.toFixed(2) + " m" : "not known");
    table.insertRow().append(cell(c.node), away(x), away(y),
      cell((turn * 180 / Math.PI).toFixed(0) + "\u00b0"), cell((100 * c.probability).toFixed(0) + " %"));
  }
  return table;
}
async function ask() {
  const file = byId("image").files[0];
  if (!file) return;
  byId("shown").src = URL.createObjectURL(file); byId("shown").hidden = false;
  const query = new URLSearchParams();
  for (const name of ["height_m", "hfov"]) if (byId(name).value) query.set(name, byId(name).value);
  say("Looking ...", "");
  for (let tries = 0; tries < 5; tries++) {
    let reply, answer;
    try {
      reply = await fetch("relocalize?" + query, { method: "POST", body: file });
      answer = await reply.json();
    } catch (error) { return say("The map server does not answer: " + error.message, "failed"); }
    if (reply.status === 503) {
      say("Many robots ask at present, waiting ...", "");
      await new Promise(done => setTimeout(done, 1000 * (answer.retry_after || 1)));
      continue;
    }
    if (!reply.ok) return say(answer.error, "failed");
    say(answer.certainty + ": " + answer.reason, answer.certainty);
    if (answer.candidates.length) result.append(table(answer.candidates));
    return;
  }
  say("The map server is too busy; try again in a minute.", "failed");
}
for (const id of ["image", "height_m", "hfov"]) byId(id).addEventListener("change", ask);
fetch("status").then(reply => reply.json())
  .then(s => { byId("status").textContent = "The map: " + s.summary; })
  .catch(() => { byId("status").textContent = "The map server does not answer."; });
