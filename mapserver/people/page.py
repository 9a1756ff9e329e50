"""The page that people open on their phone: take a picture, see where it was taken."""

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Mapweave: where am I?</title>
<style>
  body { font: 1.1rem/1.5 system-ui, sans-serif; max-width: 40rem; margin: 0 auto; padding: 1rem;
         color: #1b2733; background: #f7f8fa }
  h1 { font-size: 1.4rem }
  label { display: block; margin: .8rem 0 }
  input[type=number] { width: 6rem; font: inherit }
  input[type=file] { font: inherit; max-width: 100% }
  #result { margin-top: 1rem; padding: .8rem 1rem; border-radius: .5rem; background: #fff;
            border-left: .4rem solid #9aa7b4; min-height: 1.5rem }
  #result.found { border-color: #2a8f5b } #result.ambiguous, #result.place { border-color: #d29a1c }
  #result.failed { border-color: #c0392b }
  table { border-collapse: collapse; margin-top: .6rem; font-size: .95rem }
  td, th { text-align: left; padding: .1rem .8rem .1rem 0 }
  img { max-width: 100%; border-radius: .5rem; margin-top: .8rem }
  small { color: #5b6875 }
</style>
<h1>Where am I?</h1>
<p>Hold the phone level, take a picture, and the fleet's map says where it was taken.</p>
<label>Picture <input type="file" id="image" accept="image/jpeg,image/png" capture="environment"></label>
<label>Height of the lens above the floor
  <input type="number" id="height_m" value="1.4" step="0.05"> m</label>
<label>Angle of view, left to right
  <input type="number" id="hfov" placeholder="unknown" step="1"> degrees</label>
<div id="result" role="status">No picture yet.</div>
<img id="shown" alt="" hidden>
<p><small id="status"></small></p>
<p><small><a href="why">Why are maps one, or are not?</a></small></p>
<script>
const byId = id => document.getElementById(id), result = byId("result");
const cell = text => { const td = document.createElement("td"); td.textContent = text; return td; };
function say(text, kind) { result.className = kind; result.textContent = text; }
function table(candidates) {
  const table = document.createElement("table"), head = table.insertRow();
  for (const name of ["place", "ahead", "left", "turned", "probability"]) {
    const th = document.createElement("th"); th.textContent = name; head.append(th);
  }
  for (const c of candidates) {
    const [x, y, turn] = c.node_from_robot;
    const away = m => cell(c.distance_known ? m.toFixed(2) + " m" : "not known");
    table.insertRow().append(cell(c.node), away(x), away(y),
      cell((turn * 180 / Math.PI).toFixed(0) + "\\u00b0"), cell((100 * c.probability).toFixed(0) + " %"));
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
</script>
</html>
"""
