/** Environments of a Twinstep server over Zenoh: hello, lease, reset, step, close (protocol/SPEC.md, Session sequence). */

import { randomBytes } from "node:crypto";

import { Config, ConsolidationMode, CongestionControl, QueryTarget, ReplyError, Session } from "@eclipse-zenoh/zenoh-ts";
import type { LivelinessToken, Reply } from "@eclipse-zenoh/zenoh-ts";
import { Duration } from "typed-duration";
import WebSocket from "ws";

import { PROTOCOL, decodeMessage, encodeMessage, flags, floats, integer, length, tensor, text } from "./messages.js";
import type { Message } from "./messages.js";

const QUERY_TIMEOUT_MS = 2000;
/** Time for which a request is repeated. */
const PATIENCE_MS = 20_000;

/** An error reply of the server. */
export class RejectedError extends Error {
  constructor(
    readonly code: string,
    message: string,
    readonly retryable: boolean,
  ) {
    super(`${code}: ${message}`);
  }
}

/** Observations, and after a step what it gave. */
export interface Result {
  observations: Float32Array;
  rewards: Float32Array;
  terminated: boolean[];
  truncated: boolean[];
}

export class Environments {
  private seq: number;

  private constructor(
    private readonly session: Session,
    private readonly token: LivelinessToken,
    private readonly prefix: string,
    private readonly secret: Uint8Array,
    private readonly lease: Message,
  ) {
    this.seq = integer(lease, "last_seq");
  }

  /** Leases environments of the only visible server, or of the one with this name. `locator` is that of Zenoh's remote API. */
  static async open(locator: string, count: number, name?: string): Promise<Environments> {
    // Node has none before version 22.
    (globalThis as { WebSocket?: unknown }).WebSocket ??= WebSocket;
    const session = await Session.open(new Config(locator));
    try {
      const serverId = await findServer(session, name);
      const prefix = `twinstep/${serverId}`;
      const hello = await query(session, `${prefix}/hello`, { protocol: PROTOCOL, client: "twinstep-ts" });
      const [lowest, highest] = hello["protocols"] as [number, number];
      if (PROTOCOL < Number(lowest) || PROTOCOL > Number(highest)) {
        throw new Error(`the server speaks protocol ${lowest} to ${highest}; this client speaks ${PROTOCOL}`);
      }
      const client = `ts-${randomBytes(8).toString("hex")}`;
      const token = await session.liveliness().declareToken(`twinstep/live/client/${serverId}/${client}`);
      const secret = randomBytes(16);
      const request = { protocol: PROTOCOL, client, num_envs: count, autoreset: "NextStep" };
      const lease = await query(session, `${prefix}/lease`, request, secret);
      return new Environments(session, token, prefix, secret, lease);
    } catch (error) {
      await session.close();
      throw error;
    }
  }

  /** Specification of the task: layouts, gains, rates. */
  get spec(): Message {
    return this.lease["spec"] as Message;
  }

  get count(): number {
    return integer(this.lease, "num_envs");
  }

  get actionLength(): number {
    return length(this.spec, "action");
  }

  /** Starts new episodes; the seed of environment i is `seed` + i. */
  async reset(seed: number): Promise<Float32Array> {
    const seeds = BigUint64Array.from({ length: this.count }, (_, index) => BigInt(seed + index));
    const reply = await this.request("reset", { seeds: tensor(seeds) });
    return floats(reply, "obs");
  }

  /** Executes actions, `count` × `actionLength`, and velocity commands, `count` × 3, if given. */
  async step(actions: Float32Array, command?: Float32Array): Promise<Result> {
    const reply = await this.request("step", { actions: tensor(actions), ...(command && { command: tensor(command) }) });
    return {
      observations: floats(reply, "obs"),
      rewards: floats(reply, "reward"),
      terminated: flags(reply, "terminated"),
      truncated: flags(reply, "truncated"),
    };
  }

  /** Returns the environments to the server. */
  async close(): Promise<void> {
    try {
      await this.request("close", {});
    } finally {
      await this.token.undeclare();
      await this.session.close();
    }
  }

  /** Sends a request until a reply arrives: the server executes a sequence number once. */
  private async request(kind: string, fields: Message): Promise<Message> {
    this.seq += 1;
    const message = { protocol: PROTOCOL, epoch: integer(this.lease, "epoch"), seq: this.seq, ...fields };
    const reply = await query(this.session, `${this.prefix}/env/${text(this.lease, "lease")}/${kind}`, message, this.secret);
    if (integer(reply, "seq") !== this.seq) throw new Error(`a reply to request ${String(reply["seq"])} instead of ${this.seq}`);
    return reply;
  }
}

async function findServer(session: Session, name?: string): Promise<string> {
  const since = Date.now();
  for (;;) {
    const replies = await session.liveliness().get("twinstep/live/server/*/*", { timeout: Duration.milliseconds.of(QUERY_TIMEOUT_MS) });
    const servers: [string, string][] = [];
    for await (const reply of replies ?? []) {
      const result = reply.result();
      if (result instanceof ReplyError) continue;
      const parts = result.keyexpr().toString().split("/");
      servers.push([parts[3] ?? "", parts[4] ?? ""]);
    }
    const found = servers.filter(([, own]) => name === undefined || own === name);
    if (found.length === 1 && found[0]) return found[0][0];
    if (found.length > 1) throw new Error(`several servers: ${servers.map(([, own]) => own).join(", ")}; name one`);
    if (Date.now() - since > PATIENCE_MS) throw new Error("no server is visible: start one with `twinstep serve`");
  }
}

/** Sends a query until it is answered. An error reply is thrown, unless a repeat may help. */
async function query(session: Session, key: string, message: Message, secret?: Uint8Array): Promise<Message> {
  const since = Date.now();
  const payload = encodeMessage(message);
  for (;;) {
    const replies = await session.get(key, {
      payload,
      ...(secret && { attachment: secret }),
      target: QueryTarget.BEST_MATCHING,
      consolidation: ConsolidationMode.NONE,
      congestionControl: CongestionControl.BLOCK,
      express: true,
      timeout: Duration.milliseconds.of(QUERY_TIMEOUT_MS),
    });
    const failure = await firstReply(replies);
    if (!(failure instanceof RejectedError)) {
      if (failure !== undefined) return failure;
    } else if (!failure.retryable) {
      throw failure;
    }
    if (Date.now() - since > PATIENCE_MS) throw failure ?? new Error(`no reply at ${key} within ${PATIENCE_MS} ms`);
  }
}

async function firstReply(replies: AsyncIterable<Reply> | undefined): Promise<Message | RejectedError | undefined> {
  for await (const reply of replies ?? []) {
    const result = reply.result();
    const bytes = result.payload().toBytes();
    // Zenoh reports a timeout by an error reply with a text, which is no map.
    const isMap = bytes[0] !== undefined && ((bytes[0] & 0xf0) === 0x80 || bytes[0] === 0xde);
    if (result instanceof ReplyError && !isMap) return undefined;
    const body = decodeMessage(bytes);
    if (!(result instanceof ReplyError)) return body;
    return new RejectedError(String(body["code"]), String(body["message"]), body["retryable"] === true);
  }
  return undefined;
}
