"use strict";
// The live page: asks the server that it came from for the scene, and for newer ones until the server is gone.

const ASK_MS = 1000;

async function follow() {
  const waiting = element("p", { className: "sorry", textContent: "The object will appear here once there is one." });
  for (let version = 0; ; await new Promise((done) => setTimeout(done, ASK_MS))) {
    let scene;
    try {
      const answer = await fetch(`scene?after=${version}`);
      if (answer.status === 204) {
        if (!window.viewer) document.body.append(waiting);
        continue; // nothing newer
      }
      scene = await answer.json();
    } catch {
      waiting.remove();
      document.getElementById("hint").textContent = "The program that showed this has ended; the object stays as it was last.";
      return;
    }
    version = scene.version;
    waiting.remove();
    if (window.viewer) window.viewer.take(scene);
    else begin(scene);
    if (!window.viewer) return; // this browser cannot show it
  }
}

follow();
