"use strict";
const view = document.getElementById("view");
view.addEventListener("error", () => view.replaceWith(view.alt));
// A stream has no end: it begins when everything else is there.
addEventListener("load", () => { view.src = "stream"; });
fetch("title").then(reply => reply.json()).then(answer => { document.title = answer.title; });
