"use strict";

// The script that draws plots stands in the page compressed, so that a report stays small.
async function loadLibrary() {
  const packed = document.getElementById("library").textContent.trim();
  if (!packed) return;
  const bytes = Uint8Array.from(atob(packed), (character) => character.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(plain).text();
  document.head.append(script);
}
