// The socket: it says hello, takes messages apart by their kind, and comes back when it was cut.

import * as say from "./messages.js";

const WAITS = [250, 500, 1000, 2000];  // ms before each new try; the last one again and again
const SESSION = "countersteer-session";

/** The token of the page's address, as the query of another address of the server. */
export function withToken(address) {
  const token = new URLSearchParams(location.search).get("token");
  if (!token) return address;
  return `${address}${address.includes("?") ? "&" : "?"}token=${encodeURIComponent(token)}`;
}

export class Connection {
  /** `answers` has a function for each kind of message, and for `lost`. */
  constructor(answers) {
    Object.assign(this, { answers, tries: 0 });
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(`${scheme}//${location.host}/ws`);
    this.socket.addEventListener("open", () => {
      this.tries = 0;
      this.send(say.hello({
        token: new URLSearchParams(location.search).get("token") ?? "",
        session: sessionStorage.getItem(SESSION) ?? "",
      }));
    });
    this.socket.addEventListener("message", ({ data }) => {
      const message = JSON.parse(data);
      // The key with which a page drives on after a reload.
      if (message.kind === say.OF_SERVER.Welcome) sessionStorage.setItem(SESSION, message.session);
      this.answers[message.kind]?.(message);
    });
    this.socket.addEventListener("close", () => {
      this.answers.lost();
      const wait = WAITS[Math.min(this.tries++, WAITS.length - 1)];
      setTimeout(() => this.open(), wait);
    });
  }

  get isOpen() { return this.socket.readyState === WebSocket.OPEN; }

  /** Send a message; one that cannot be sent now is dropped, for it would come too late. */
  send(message) { if (this.isOpen) this.socket.send(JSON.stringify(message)); }
}
