// Browsers start no worker from a file. Where the site is read from files, the worker
// of the search runs in a hidden frame instead; on a server nothing changes.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    onmessage = null;
    onerror = null;
    onmessageerror = null;

    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inside = this.frame.contentWindow;
      // What is posted is a copy, and arrives later, as from a thread.
      inside.postMessage = (posted) => {
        const data = structuredClone(posted);
        setTimeout(() => this.tell(new MessageEvent("message", { data })));
      };
      const script = inside.document.createElement("script");
      this.started = new Promise((start) => (script.onload = start));
      script.onerror = () => this.tell(new Event("error"));
      script.src = new URL(url, document.baseURI);
      inside.document.head.append(script);
    }

    tell(event) {
      this.dispatchEvent(event);
      this[`on${event.type}`]?.(event);
    }

    postMessage(posted) {
      const data = structuredClone(posted);
      const inside = this.frame.contentWindow;
      this.started.then(() =>
        inside.dispatchEvent(new inside.MessageEvent("message", { data })),
      );
    }

    terminate() {
      this.frame.remove();
    }
  };
}
