/** Decodes every golden message, encodes it again, and compares the meaning; requests of this client have their exact fields. */

import { readdirSync, readFileSync } from "node:fs";
import assert from "node:assert/strict";

import { decodeMessage, encodeMessage, floats, integer, length } from "./messages.js";

const folder = new URL("../../../protocol/golden/", import.meta.url);
const names = readdirSync(folder).filter((name) => name.endsWith(".msgpack"));
const read = (name: string) => decodeMessage(new Uint8Array(readFileSync(new URL(name, folder))));
for (const name of names) {
  const message = read(name);
  assert.deepEqual(decodeMessage(encodeMessage(message)), message, name);
}
const hello = read("hello_reply.msgpack");
const spec = hello["spec"] as Record<string, unknown>;
const step = read("step_reply.msgpack");
assert.equal(floats(step, "obs").length % length(spec, "observation"), 0);
assert.equal(integer(step, "protocol"), 1);
console.log(`${names.length} golden messages`);
