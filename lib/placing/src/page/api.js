// Requests to the server of this page. Addresses are relative, so that they carry the token.

async function failed(response) {
  const text = await response.text();
  try {
    return new Error(JSON.parse(text).error);
  } catch {
    return new Error(text || `${response.status}`);
  }
}

export async function state() {
  const response = await fetch("state");
  if (!response.ok) throw await failed(response);
  return response.json();
}

export async function ask(route, body) {
  const response = await fetch(route, { method: "POST", body: JSON.stringify(body) });
  if (!response.ok) throw await failed(response);
  return response.json();
}

export async function ownMask() {
  const response = await fetch("mask.bin");
  if (!response.ok) throw await failed(response);
  return new Uint8ClampedArray(await response.arrayBuffer());
}

export async function sendMask(bytes) {
  const response = await fetch("mask", { method: "POST", body: bytes });
  if (!response.ok) throw await failed(response);
}

// A picture as {image, place, light}; null if the objects change nothing, undefined if a newer one was
// asked for.
async function picture(route, body) {
  const response = await fetch(route, { method: "POST", body: JSON.stringify(body) });
  if (response.status === 409) return undefined;
  if (response.status === 204) return null;
  if (!response.ok) throw await failed(response);
  const about = JSON.parse(response.headers.get("X-Draft"));
  return { image: await createImageBitmap(await response.blob()), ...about };
}

export const draft = (edit, samples) => picture("draft", { edit, samples });

// The same objects under another sun or exposure: coarse, and at once where they are recorded.
export const relight = (edit) => picture("relight", edit);

// Calls `work` with the latest argument only: while one call runs, all but the last that come are
// dropped.
export function latest(work) {
  let running = false;
  let next = null;
  return async function call(argument) {
    next = { argument };
    if (running) return;
    running = true;
    try {
      while (next) {
        const { argument: taken } = next;
        next = null;
        await work(taken);
      }
    } finally {
      running = false;
    }
  };
}
