// Requests to the server of this page. Addresses are relative, so that they carry the token.

async function failed(response) {
  const text = await response.text();
  let message = text || `${response.status}`;
  try {
    message = JSON.parse(text).error;
  } catch {}
  return Object.assign(new Error(message), { refused: true });
}

// An answer; an error is `refused` if the server gave it. One to a picture that a newer one broke off is 409.
async function request(route, body) {
  let response;
  try {
    response = await fetch(route, body === undefined ? {} : { method: "POST", body });
  } catch {
    throw new Error("dipir place does not answer. If it was ended, start it again and open the address that it prints.");
  }
  if (!response.ok && response.status !== 409) throw await failed(response);
  return response;
}

export const state = async () => (await request("state")).json();

export const ask = async (route, body) => (await request(route, JSON.stringify(body))).json();

export const ownMask = async () => new Uint8ClampedArray(await (await request("mask.bin")).arrayBuffer());

export const sendMask = (bytes) => request("mask", bytes);

// A picture as {image, place, light}; null if the objects change nothing, undefined if a newer one was
// asked for.
async function picture(route, body) {
  const response = await request(route, JSON.stringify(body));
  if (response.status === 409) return undefined;
  if (response.status === 204) return null;
  const about = JSON.parse(response.headers.get("X-Draft"));
  return { image: await createImageBitmap(await response.blob()), ...about };
}

// A newer picture breaks off the older ones of its own tab alone.
const tab = Math.floor(Math.random() * 2 ** 32);

export const draft = (edit, samples) => picture("draft", { edit, samples, tab });

// The same objects under another sun or exposure: coarse, and at once where they are recorded.
export const relight = (edit) => picture("relight", { edit, tab });

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
