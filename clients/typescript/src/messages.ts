/** Messages of the protocol as MessagePack maps, and tensors as bytes (protocol/SPEC.md, Basics). */

import { decode, encode } from "@msgpack/msgpack";

export const PROTOCOL = 1;

export type Message = Record<string, unknown>;

/** Encodes a request. Integers beyond 2^53 are `bigint`. */
export function encodeMessage(message: Message): Uint8Array {
  return encode(message, { useBigInt64: true });
}

/** Decodes a reply. Integers of 64 bits become numbers, or `bigint` where a number cannot hold them. */
export function decodeMessage(bytes: Uint8Array): Message {
  const message = decode(bytes, { useBigInt64: true });
  if (typeof message !== "object" || message === null || Array.isArray(message) || message instanceof Uint8Array) {
    throw new Error("a message is a MessagePack map with string keys");
  }
  return message as Message;
}

/** Returns a field that is an unsigned integer. */
export function integer(message: Message, field: string): number {
  const value = message[field];
  const number = typeof value === "bigint" ? Number(value) : value;
  if (typeof number !== "number" || !Number.isSafeInteger(number) || number < 0) {
    throw new Error(`\`${field}\` is ${String(value)}; an unsigned integer is expected`);
  }
  return number;
}

/** Returns a field that is a text. */
export function text(message: Message, field: string): string {
  const value = message[field];
  if (typeof value !== "string") throw new Error(`\`${field}\` is ${String(value)}; a text is expected`);
  return value;
}

function bytes(message: Message, field: string, size: number): Uint8Array {
  const value = message[field];
  if (!(value instanceof Uint8Array) || value.length % size !== 0) {
    throw new Error(`\`${field}\` is not a tensor with entries of ${size} bytes`);
  }
  // Tensors are not aligned in a message.
  return value.slice();
}

/** Returns a tensor of 32-bit floats. */
export function floats(message: Message, field: string): Float32Array {
  const copy = bytes(message, field, 4);
  return new Float32Array(copy.buffer, copy.byteOffset, copy.length / 4);
}

/** Returns a tensor of flags. */
export function flags(message: Message, field: string): boolean[] {
  return Array.from(bytes(message, field, 1), (flag) => flag !== 0);
}

/** Returns the bytes of a tensor. All machines that run JavaScript are little-endian. */
export function tensor(values: Float32Array | BigUint64Array): Uint8Array {
  return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
}

/** Number of entries of the fields of a `spec`. */
export function length(spec: Message, group: string): number {
  const fields = (spec[group] ?? []) as Message[];
  return fields.reduce((sum, field) => sum + integer(field, "size"), 0);
}
